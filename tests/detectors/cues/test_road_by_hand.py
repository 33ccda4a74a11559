"""Fractions of road (eq. 13, 14) in the picture, with numbers by hand."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from crosscue.detectors import rle
from crosscue.detectors.base import RoadMask
from crosscue.detectors.cues.observed import RoadFractions
from crosscue.detectors.cues.road import is_road, region_mask, road_fractions
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.vehicle import Cues, Polygon, Regions, Vehicle

NAN = math.nan


def mask(road: NDArray[np.bool_], size_px: tuple[int, int] | None = None) -> RoadMask:
    size = (road.shape[1], road.shape[0])
    return RoadMask(0, size_px or size, rle.encode_mask(road, (0, 0), size), size)


@pytest.mark.parametrize(
    ("polygon", "shape", "inside"),
    [
        (((0, 0), (1, 0), (0, 1)), (4, 4), ["xxx.", "xx..", "x...", "...."]),  # x + y < 1
        (((0, 0), (1, 0), (1, 1)), (2, 4), [".xxx", "...x"]),  # x >= y
        (((0, 0.25), (1, 0.25), (1, 0.75), (0, 0.75)), (2, 2), ["xx", ".."]),  # 0.25 <= y < 0.75
        (((0.25, 0), (0.75, 0), (0.75, 1), (0.25, 1)), (1, 2), ["x."]),  # 0.25 <= x < 0.75
        (((0, 0), (1, 0), (0, 1), (1, 1)), (4, 4), ["xxx.", ".x..", ".x..", "xxx."]),
    ],
)
def test_region_contains_pixels_whose_centres_are_inside(
    polygon: Polygon, shape: tuple[int, int], inside: list[str]
) -> None:
    """Centres are at (0.5, 1.5, ...) / width and height; the upper and left edge belong to it.

    Of the last one, whose sides intersect, x < 1 - y and x < y exclude each other.
    """
    found = region_mask(polygon, shape)

    assert found.dtype == np.bool_
    assert ["".join("x" if one else "." for one in row) for row in found.tolist()] == inside


def test_fractions_are_road_pixels_over_pixels_of_each_region() -> None:
    """Mask of 8 x 2 pixels, and regions of 4, 2 and 1 pixels with 1, 1 and 1 road pixels.

    Left: 1 / 4; straight: 1 / 2; right: 1 / 1. A region without a pixel has no road.
    """
    regions = Regions(
        kind="picture",
        left=((0, 0), (0.25, 0), (0.25, 1), (0, 1)),
        straight=((0.5, 0), (0.625, 0), (0.625, 1), (0.5, 1)),
        right=((0.875, 0), (1, 0), (1, 0.5), (0.875, 0.5)),
    )
    road = np.zeros((2, 8), np.bool_)
    road[1, [0, 2, 4, 7]] = True
    road[0, 7] = True

    assert road_fractions(mask(road), regions) == RoadFractions(0.25, 0.5, 1.0)
    empty = regions.model_copy(update={"left": ((0, 0), (0.01, 0), (0.01, 0.01))})
    assert road_fractions(mask(road), empty) == RoadFractions(0.0, 0.5, 1.0)


@pytest.mark.parametrize(
    ("left", "straight", "right", "counts"),
    [
        (0.2, 0.21, 0.0, (0, 1, 0)),  # 0.2 is not more than 0.2
        (0.21, 0.2, NAN, (1, 0, None)),
        (0.0, 1.0, 0.2, (0, 1, 0)),
        (NAN, NAN, 1.0, (None, None, 1)),
    ],
)
def test_road_is_a_cue_above_the_fraction(
    left: float, straight: float, right: float, counts: tuple[int | None, ...]
) -> None:
    """Each cue compares the fraction of its own side with 0.2 (eq. 14)."""
    vehicle = Vehicle(version=1, cues=Cues(road_fraction=0.2))
    fractions = RoadFractions(left, straight, right)

    found = [
        is_road(fractions, vehicle, CUES[f"road_{side}"]).number
        for side in ("left", "straight", "right")
    ]

    assert tuple(found) == counts
    assert fractions.positive(0.2) == tuple(count == 1 for count in counts)
