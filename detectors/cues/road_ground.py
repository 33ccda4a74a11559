"""Fractions of road to the left, ahead and to the right of an intersection, in ground regions.

The dissertation's regions are fixed in the picture (eq. 13). A wide ego road, or its lanes far
ahead, then overlap the region for "right". Here a region is a rectangle on level ground, placed
relative to the estimated intersection. The side regions cover the middle half between its start and
end, beyond the width of the ego road. The straight region is the lane beyond its end. The
rectangles are projected with the camera's mounting and intrinsics.

A region is **not seen**, which is evidence neither for nor against a road, in these cases:

* No range is known, or the region is at or behind the camera.
* The uncertainty of its position exceeds the margin to the intersection's ends. It consists of the
  range's standard deviation and the effect of the camera's pitch at distance ``D``,
  ``D**2 * pitch_sd_rad / z_m``.
* It spans fewer than ``min_rows`` rows of the segmentation, or three quarters of it are outside the
  picture.
"""

from __future__ import annotations

import math
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import RoadMask
from crosscue.detectors.ranging.ground_plane import GroundPlane
from crosscue.replay.vehicle.vehicle import Camera, Regions

from .observed import NOT_SEEN, Place, RoadFractions

# Fraction of the intersection's depth that is left out at either end.
MARGIN: Final = 0.25
MIN_IN_PICTURE: Final = 0.25
# Distance ahead of the camera below which nothing is projected.
NEAREST_M: Final = 1.0

# Minimum and maximum distance ahead of the rear axle, then to its left, in metres.
Rectangle: TypeAlias = tuple[float, float, float, float]


def ground_fractions(
    road: RoadMask, camera: Camera, regions: Regions, place: Place | None
) -> RoadFractions:
    """Compute fractions of road in regions on the ground; NaN for a region that is not seen.

    Raises:
        ValueError: The mask is damaged.
    """
    if place is None or camera.focal_px is None:
        return NOT_SEEN
    is_road = road.pixels()
    fractions = [
        _fraction(is_road, road, camera, regions, one, margin_m, place.sd_m)
        for one, margin_m in rectangles(regions, place)
    ]
    return RoadFractions(*fractions)


def rectangles(regions: Regions, place: Place) -> tuple[tuple[Rectangle, float], ...]:
    """Left, straight and right rectangle, each with its margin to the intersection's ends."""
    margin_m = MARGIN * (place.end_m - place.start_m)
    first, last = place.start_m + margin_m, place.end_m - margin_m
    near_m, far_m = regions.aside_m
    begin_m, stop_m = (place.end_m + beyond for beyond in regions.beyond_m)
    half_m = regions.half_width_m
    return (
        ((first, last, near_m, far_m), margin_m),
        ((begin_m, stop_m, -half_m, half_m), regions.beyond_m[0]),
        ((first, last, -far_m, -near_m), margin_m),
    )


def outlines(
    camera: Camera, regions: Regions, place: Place | None, size_px: tuple[int, int]
) -> tuple[NDArray[np.float64] | None, ...]:
    """Corners of the left, straight and right region in the picture, shape (4, 2) each.

    A region is None if it is at or behind the camera, if no range is known, or without regions.
    """
    if regions.kind == "picture":
        return tuple(np.array(one) * size_px for one in regions.polygons())
    if regions.kind != "ground" or place is None or camera.focal_px is None or camera.z_m <= 0.0:
        return None, None, None
    ground = GroundPlane.of(camera, size_px)
    found = [_outline(one, ground) for one, _ in rectangles(regions, place)]
    return tuple(found)


def _outline(one: Rectangle, ground: GroundPlane) -> NDArray[np.float64] | None:
    """Corners in the picture; None if one of them is next to or behind the camera."""
    if one[0] - ground.position_m[0] < NEAREST_M:
        return None
    corners = ground.project(_corners(one))
    return None if np.isnan(corners).any() else corners


def _corners(one: Rectangle) -> NDArray[np.float64]:
    first, last, rightmost, leftmost = one
    return np.array([(first, rightmost), (first, leftmost), (last, leftmost), (last, rightmost)])


def _fraction(
    is_road: NDArray[np.bool_],
    road: RoadMask,
    camera: Camera,
    regions: Regions,
    one: Rectangle,
    margin_m: float,
    place_sd_m: float,
) -> float:
    """Fraction of road pixels in one rectangle; NaN if it is not seen."""
    away_m = one[0] - camera.x_m
    corners = _outline(one, GroundPlane.of(camera, road.size_px))
    if corners is None or camera.z_m <= 0.0:
        return math.nan
    doubt_m = math.hypot(place_sd_m, away_m**2 * camera.pitch_sd_rad / camera.z_m)
    if doubt_m > margin_m:
        return math.nan
    scale = np.array(road.mask_size_px) / np.array(road.size_px)
    polygon = corners * scale
    if polygon[:2, 1].mean() - polygon[2:, 1].mean() < regions.min_rows:
        return math.nan
    inside = _inside(polygon, is_road.shape)
    count = int(np.count_nonzero(inside))
    if count < max(MIN_IN_PICTURE * _area(polygon), 1.0):
        return math.nan
    return float(np.count_nonzero(is_road & inside) / count)


def _inside(polygon: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Mark the pixels whose centres are in a convex polygon, clockwise as shown; shape (h, w)."""
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]] + 0.5
    signs: list[NDArray[np.float64]] = []
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        signs.append((x1 - x0) * (y - y0) - (y1 - y0) * (x - x0))
    inside: NDArray[np.bool_] = np.min(signs, axis=0) >= 0.0
    return inside


def _area(polygon: NDArray[np.float64]) -> float:
    x, y = polygon.T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
