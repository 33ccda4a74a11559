"""Range of a vehicle from one box, by the ground and by its height.

On level ground, a point at depth R is below the horizon by an angle of tangent z / R, for a camera
at height z. The lower edge of a box therefore yields a range, whose error by the camera's pitch
grows with the square of the distance: 0.3 degrees are 1 m at 20 m, and 6 m at 50 m. The height of
the box yields another range, whose relative error by the spread of vehicles' heights is constant.
The logarithms of the two are weighted by their variances: the ground dominates at short range, the
size at long range.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

from .standard_sizes import SizePrior

EDGE_PX: Final = 1.0
# Standard deviation of a box's edge as a fraction of the box's height, added to ``EDGE_PX`` in
# squares.
EDGE_FRACTION: Final = 0.03
# Standard deviation by the overhang ahead of the wheels and by uneven roads.
OVERHANG_M: Final = 0.5
# Relative standard deviation of the camera's height, by load and suspension.
CAMERA_HEIGHT_SD: Final = 0.05
# Minimum distance of a box's edge below the horizon, in standard deviations.
MIN_SIGMAS: Final = 2.0


@dataclass(frozen=True, slots=True)
class GroundCamera:
    """Camera over level ground.

    Attributes:
        focal_px: Focal length.
        height_m: Height above the ground.
        pitch_sd_rad: Standard deviation of its pitch in a frame.
    """

    focal_px: float
    height_m: float
    pitch_sd_rad: float = 0.005


class OneRange(NamedTuple):
    """Depth from the camera and its standard deviation."""

    mean_m: float
    sd_m: float


def size_range(height_px: float, focal_px: float, size: SizePrior) -> OneRange:
    """Range of an object of a standard size, R = f H / h, with the errors of H and of the box.

    Args:
        height_px: Height of its box, positive.
        focal_px: Focal length.
        size: Size prior of the object.
    """
    mean_m = focal_px * size.mean_m / height_px
    return OneRange(mean_m, mean_m * math.hypot(size.spread, _edge_px(height_px) / height_px))


def ground_range(slope: float, height_px: float, camera: GroundCamera) -> OneRange | None:
    """Range of an object that stands on the ground at a box's lower edge.

    Args:
        slope: Downward slope of the ray through the edge, per metre ahead of the car.
        height_px: Height of the box.
        camera: Camera over level ground.

    Returns:
        The range, or None at or near the horizon, where the edge has no information.
    """
    below_rad = math.atan(slope)
    angle_sd = math.hypot(camera.pitch_sd_rad, _edge_px(height_px) / camera.focal_px)
    if not MIN_SIGMAS * angle_sd < below_rad < 0.5 * math.pi or camera.height_m <= 0.0:
        return None
    mean_m = camera.height_m / slope
    slope_m = mean_m**2 / camera.height_m + camera.height_m
    spoiled_m = math.hypot(slope_m * angle_sd, CAMERA_HEIGHT_SD * mean_m, OVERHANG_M)
    return OneRange(mean_m, spoiled_m)


def vehicle_range(
    slope: float, height_px: float, camera: GroundCamera, size: SizePrior
) -> OneRange:
    """Range of a vehicle by ground and size.

    Args:
        slope: Slope of the ray through its box's lower edge, as for ``ground_range``.
        height_px: Height of its box, positive.
        camera: Camera over level ground.
        size: Size prior of vehicles.
    """
    by_size = size_range(height_px, camera.focal_px, size)
    by_ground = ground_range(slope, height_px, camera)
    if by_ground is None:
        return by_size
    weights = [(one.mean_m / one.sd_m) ** 2 for one in (by_size, by_ground)]
    logs = [math.log(one.mean_m) for one in (by_size, by_ground)]
    both = sum(weights)
    mean_m = math.exp(sum(w * log for w, log in zip(weights, logs, strict=True)) / both)
    return OneRange(mean_m, mean_m / math.sqrt(both))


def _edge_px(height_px: float) -> float:
    return math.hypot(EDGE_PX, EDGE_FRACTION * height_px)
