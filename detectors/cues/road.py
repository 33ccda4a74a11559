"""Fractions of road in the left, straight and right region of a picture (eq. 13, 14)."""

from __future__ import annotations

import math
from collections.abc import Collection
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import RoadMask
from crosscue.replay.vehicle.vehicle import CueSpec, Polygon, Regions, Vehicle

from .candidates import REGION_NOT_SEEN, TOO_LITTLE_ROAD, Count
from .observed import RoadFractions

SETTING: Final = "[cues] road_fraction"


def is_road(fractions: RoadFractions, vehicle: Vehicle, cue: CueSpec) -> Count:
    """Count 1 if enough of the cue's region is road, else 0 (eq. 14); unknown if it is not seen."""
    fraction: float = getattr(fractions, cue.supports[0])
    limit = vehicle.cues.road_fraction
    if math.isnan(fraction):
        return Count(None, [0.0], {REGION_NOT_SEEN: 1}, [limit], SETTING, "frames")
    scores = [fraction] if fraction > 0.0 else []
    low = sum(one <= limit for one in scores)
    return Count(int(fraction > limit), scores, {TOO_LITTLE_ROAD: low}, [limit], SETTING, "frames")


def is_on_map(sides: Collection[str], vehicle: Vehicle, cue: CueSpec) -> int:
    """Count 1 if the map has a way out of the next intersection on the cue's side, else 0."""
    return int(cue.supports[0] in sides)


@lru_cache(maxsize=64)
def region_mask(polygon: Polygon, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Mark the pixels whose centres are in a polygon, shape (h, w), by the even-odd rule."""
    height, width = shape
    y, x = np.mgrid[0:height, 0:width]
    x, y = (x + 0.5) / width, (y + 0.5) / height
    inside = np.zeros(shape, np.bool_)
    for (x0, y0), (x1, y1) in zip(polygon, (*polygon[1:], polygon[0]), strict=True):
        if y0 == y1:
            continue
        crosses = (y0 <= y) != (y1 <= y)
        inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


def outlines(regions: Regions, size_px: tuple[int, int]) -> tuple[NDArray[np.float64], ...]:
    """Corners of the left, straight and right region in a picture; none unless fixed in it."""
    if regions.kind != "picture":
        return ()
    return tuple(np.array(one) * size_px for one in regions.polygons())


def road_fractions(road: RoadMask, regions: Regions) -> RoadFractions:
    """Compute the fraction of road in each region (eq. 13); regions are scaled to the mask.

    Raises:
        ValueError: The mask is damaged.
    """
    width, height = road.mask_size_px
    is_road = road.pixels()
    fractions = []
    for polygon in regions.polygons():
        inside = region_mask(polygon, (height, width))
        count = int(np.count_nonzero(inside))
        fractions.append(float(np.count_nonzero(is_road & inside) / count) if count else 0.0)
    return RoadFractions(*fractions)
