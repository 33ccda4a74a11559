"""Tests of the fractions of road in regions of the picture."""

from collections.abc import Collection

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from crosscue.detectors import rle
from crosscue.detectors.base import RoadMask
from crosscue.detectors.cues.observed import RoadFractions
from crosscue.detectors.cues.road import is_on_map, outlines, road_fractions
from crosscue.replay.errors import VehicleError
from crosscue.replay.vehicle.vehicle import CUES, SIMULATED_CAR, Regions, Vehicle, parse


def _mask(road: NDArray[np.bool_]) -> RoadMask:
    size = (road.shape[1], road.shape[0])
    return RoadMask(0, size, rle.encode_mask(road, (0, 0), size), size)


def test_full_road_mask_has_fraction_one_and_empty_mask_zero() -> None:
    full = road_fractions(_mask(np.ones((90, 160), np.bool_)), Regions())

    assert full == RoadFractions(1.0, 1.0, 1.0)
    assert road_fractions(_mask(np.zeros((90, 160), np.bool_)), Regions()) == RoadFractions(0, 0, 0)


@settings(max_examples=20)
@given(seed=st.integers(0, 999))
def test_mirrored_mask_swaps_left_and_right_fractions(seed: int) -> None:
    road = np.random.default_rng(seed).random((90, 160)) < 0.3

    seen = road_fractions(_mask(road), Regions())
    mirrored = road_fractions(_mask(road[:, ::-1]), Regions())

    assert (mirrored.left, mirrored.right) == pytest.approx((seen.right, seen.left))
    assert mirrored.straight == pytest.approx(seen.straight)


@pytest.mark.parametrize("factor", [2, 3, 5])
def test_fractions_do_not_depend_on_the_mask_resolution(factor: int) -> None:
    road = np.zeros((100, 200), np.bool_)
    road[55:70, 10:30] = True
    finer = np.kron(road, np.ones((factor, factor), np.bool_)).astype(np.bool_)

    coarse, fine = (road_fractions(_mask(one), Regions()) for one in (road, finer))

    assert fine.left == pytest.approx(coarse.left, abs=0.02)
    assert coarse.left == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("left = [[0.0, 0.5], [0.2, 0.5]]", "regions.left"),
        ("left = [[0.0, 0.5], [0.2, 1.5], [0.2, 0.9]]", "less than or equal to 1"),
        ("lefd = [[0.0, 0.5], [0.2, 0.5], [0.2, 0.9]]", "did you mean left?"),
        ('kind = "ground"', "regions.kind: input should be 'picture' or 'area', got 'ground'"),
        ("aside_m = [12.0, 20.0]", "regions.aside_m: no such key; there are: kind, left"),
    ],
)
def test_invalid_region_is_refused(text: str, message: str) -> None:
    with pytest.raises(VehicleError, match=message.replace("?", r"\?")):
        parse(f"version = 1\n[regions]\n{text}\n", "v.toml")


def test_regions_default_to_the_road_area_unless_drawn_or_simulated() -> None:
    drawn = "[regions]\nleft = [[0.0, 0.5], [0.2, 0.5], [0.2, 0.6]]\n"

    assert parse("version = 1", "a.toml").regions.kind == "area"
    assert parse("version = 1\n" + drawn, "a.toml").regions.kind == "picture"
    assert Vehicle(version=1, name=SIMULATED_CAR).regions.kind == "picture"


def test_outlines_are_the_polygons_in_pixels_and_none_of_the_accumulated_road() -> None:
    left = ((0.0, 0.5), (0.25, 0.5), (0.25, 0.75))
    regions = Regions(kind="picture", left=left)

    found = outlines(regions, (400, 200))

    np.testing.assert_array_equal(found[0], [(0.0, 100.0), (100.0, 100.0), (100.0, 150.0)])
    assert len(found) == 3
    assert outlines(regions.model_copy(update={"kind": "area"}), (400, 200)) == ()


@pytest.mark.parametrize("sides", [{"left", "right"}, {"straight"}, ()])
def test_way_out_on_the_map_counts_for_its_side(sides: Collection[str]) -> None:
    for side in ("left", "straight", "right"):
        counted = is_on_map(sides, Vehicle(version=1), CUES[f"map_{side}"])
        assert counted == (side in sides)
