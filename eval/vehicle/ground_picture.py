"""Drawing of a vehicle file's camera settings on a picture: horizon, ground grid and regions.

The road is assumed to be level. Regions on the ground depend on the estimated intersection, which
is unknown here, so they are drawn for an assumed intersection ahead.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.cues.observed import Place
from crosscue.detectors.cues.road_ground import rectangles
from crosscue.detectors.ranging.ground_plane import GroundPlane
from crosscue.replay.vehicle.vehicle import Camera, Vehicle

AHEAD_M: Final = (5, 10, 15, 20, 30, 50, 80)
ASIDE_M: Final = (-15, -10, -5, 0, 5, 10, 15)
# Distance ahead of the camera at which the grid begins.
NEAREST_M: Final = 0.5
# Assumed intersection for which regions are drawn.
ASSUMED: Final = Place(30.0, 50.0, 0.0)
YELLOW, WHITE, GREEN, BLACK = (0, 230, 255), (255, 255, 255), (80, 230, 80), (0, 0, 0)


def draw_ground(pixels: NDArray[np.uint8], vehicle: Vehicle) -> NDArray[np.uint8]:
    """Return a copy with the horizon, a grid in metres on the road, and the regions.

    Args:
        pixels: Shape (H, W, 3), uint8, in BGR order.
        vehicle: Settings of the camera and regions.
    """
    canvas = pixels.copy()
    size_px = (pixels.shape[1], pixels.shape[0])
    scale = max(size_px[0] / 1280, 0.5)
    camera = vehicle.camera
    ground = GroundPlane.of(camera, size_px)
    if camera.focal_px is not None:
        sides = np.array([0.0, float(size_px[0])])
        y = ground.horizon_px(sides)
        _line(canvas, np.column_stack([sides, y]), YELLOW, scale)
        _write(canvas, "horizon", (8.0, float(y[0]) - 6.0), YELLOW, scale)
    if camera.focal_px is not None and camera.z_m > 0.0:
        for line, text in _grid(camera):
            points = ground.project(line)
            if np.isnan(points).any():
                continue
            _line(canvas, points, WHITE, 0.6 * scale)
            x, below = points[0].tolist()
            if text and below < size_px[1]:
                _write(canvas, text, (x + 4.0, below - 4.0), WHITE, scale)
    for name, polygon in _regions(vehicle, size_px):
        _line(canvas, np.vstack([polygon, polygon[:1]]), GREEN, scale)
        middle = polygon.mean(axis=0)
        _write(canvas, name, (float(middle[0]), float(middle[1])), GREEN, scale)
    return canvas


def _grid(camera: Camera) -> Iterator[tuple[NDArray[np.float64], str]]:
    """Yield labelled lines across the road, from left to right, then lines along it."""
    for ahead in AHEAD_M:
        if ahead - camera.x_m > NEAREST_M:
            across = np.array([[ahead, max(ASIDE_M)], [ahead, min(ASIDE_M)]], np.float64)
            yield across, f"{ahead} m ahead"
    near = camera.x_m + max(NEAREST_M, 2.0 * camera.z_m)
    for aside in ASIDE_M:
        yield np.array([[near, aside], [max(AHEAD_M), aside]], np.float64), ""


def _regions(
    vehicle: Vehicle, size_px: tuple[int, int]
) -> Iterator[tuple[str, NDArray[np.float64]]]:
    regions, camera = vehicle.regions, vehicle.camera
    names = ("left", "straight", "right")
    if regions.kind == "picture":
        for name in names:
            yield name, np.array(getattr(regions, name), np.float64) * np.array(size_px)
        return
    if camera.focal_px is None or camera.z_m <= 0.0 or regions.kind == "area":
        return
    for name, (one, _) in zip(names, rectangles(regions, ASSUMED), strict=True):
        first, last, rightmost, leftmost = one
        corners = [(first, rightmost), (first, leftmost), (last, leftmost), (last, rightmost)]
        if first - camera.x_m > NEAREST_M:
            outline = GroundPlane.of(camera, size_px).project(np.array(corners))
            if not np.isnan(outline).any():
                yield name, outline


def _line(
    canvas: NDArray[np.uint8],
    points: NDArray[np.float64],
    colour: tuple[int, int, int],
    scale: float,
) -> None:
    high, wide = canvas.shape[:2]
    # A polygon may extend far beyond the picture, but OpenCV's coordinates are limited.
    clipped = np.clip(points, -4.0 * max(high, wide), 4.0 * max(high, wide))
    places = np.rint(clipped * 16).astype(np.int32).reshape(-1, 1, 2)
    thick = max(1, round(2 * scale))
    cv2.polylines(canvas, [places], False, BLACK, thick + 2, cv2.LINE_AA, 4)
    cv2.polylines(canvas, [places], False, colour, thick, cv2.LINE_AA, 4)


def _write(
    canvas: NDArray[np.uint8],
    text: str,
    at: tuple[float, float],
    colour: tuple[int, int, int],
    scale: float,
) -> None:
    high, wide = canvas.shape[:2]
    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.6 * scale
    (width, height), _ = cv2.getTextSize(text, font, size, 1)
    place = (
        int(min(max(at[0], 2.0), wide - width - 2.0)),
        int(min(max(at[1], height + 2.0), high - 4.0)),
    )
    cv2.putText(canvas, text, place, font, size, BLACK, max(3, round(4 * scale)), cv2.LINE_AA)
    cv2.putText(canvas, text, place, font, size, colour, max(1, round(1.4 * scale)), cv2.LINE_AA)
