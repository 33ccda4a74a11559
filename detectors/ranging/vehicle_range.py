"""Range of a vehicle from one box: where it stands on the ground, and how high vehicles are.

On level ground a point at depth R is seen below the horizon by an angle whose tangent is z / R, for
a camera at height z. So the lower edge of a box gives a range, which the camera's pitch spoils with
the square of the distance: 0.3 degrees are 1 m at 20 m, and 6 m at 50 m. The height of the box
gives another, which the spread of vehicles' heights spoils by the same fraction everywhere. Their
logarithms are weighed by their variances: near, the ground decides, and far away, the size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

from .standard_sizes import SizePrior

EDGE_PX: Final = 1.0
EDGE_FRACTION: Final = 0.03
"""Standard deviation of a box's edge: so many pixels, and this fraction of its height, in
squares."""
OVERHANG_M: Final = 0.5
"""What is ahead of the wheels that stand on the ground, and road that is not level."""
CAMERA_HEIGHT_SD: Final = 0.05
"""Of the camera's height, as a fraction: load and springs."""
MIN_SIGMAS: Final = 2.0
"""An edge less than so many standard deviations below the horizon says nothing."""


@dataclass(frozen=True, slots=True)
class GroundCamera:
    """Camera over level ground.

    Attributes:
        focal_px: Focal length.
        height_m: Above the ground.
        pitch_sd_rad: How far its pitch is off in a frame.
    """

    focal_px: float
    height_m: float
    pitch_sd_rad: float = 0.005


class OneRange(NamedTuple):
    """Depth from the camera, and its standard deviation."""

    mean_m: float
    sd_m: float


def size_range(height_px: float, focal_px: float, size: SizePrior) -> OneRange:
    """Range of an object of a standard size: R = f H / h, as unsure as H and the box.

    Args:
        height_px: Of its box, positive.
        focal_px: Of the camera.
        size: Of the object.
    """
    mean_m = focal_px * size.mean_m / height_px
    return OneRange(mean_m, mean_m * math.hypot(size.spread, _edge_px(height_px) / height_px))


def ground_range(slope: float, height_px: float, camera: GroundCamera) -> OneRange | None:
    """Range of what stands on the ground at a box's lower edge.

    Args:
        slope: Of the ray through the edge: so far down, as seen from the camera, for each metre
            ahead of the car.
        height_px: Of the box.
        camera: Over level ground.

    Returns:
        None at or near the horizon, where the edge says nothing.
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
        slope: Of the ray through its box's lower edge, as for ``ground_range``.
        height_px: Of its box, positive.
        camera: Over level ground.
        size: Of vehicles.
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
