"""Range of a single detection: by a fitted curve, or by standard sizes and the ground.

Curves are set in the vehicle file. Without a curve, and with ``camera.focal_px``, the default range
of lights, signs and vehicles is R = f H / h with their standard size; for vehicles it is combined
with the ground's. The standard deviation includes the spread of sizes. ``ranges.kind = "curve"``
disables the defaults.

A vehicle's range comes from the ground and from its height. On level ground, a point at depth R is
below the horizon by an angle of tangent z / R, for a camera at height z. The lower edge of a box
therefore yields a range, whose error by the camera's pitch grows with the square of the distance:
0.3 degrees are 1 m at 20 m, and 6 m at 50 m. The height of the box yields another range, whose
relative error by the spread of vehicles' heights is constant. The logarithms of the two are
weighted by their variances: the ground dominates at short range, the size at long range.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.vehicle.vehicle import Vehicle

from .ground_plane import GroundPlane
from .height_to_range import range_of
from .standard_sizes import VEHICLES, SizePrior, size_prior
from .usable import is_cut

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


def detection_range(
    vehicle: Vehicle,
    label: str,
    box_px: NDArray[np.float64],
    height_px: float,
    size_px: tuple[int, int],
) -> OneRange | None:
    """Range from the rear axle; None without a curve and a default.

    Args:
        vehicle: Curves, camera and labels.
        label: Label of the detection.
        box_px: x0, y0, x1, y1.
        height_px: Number of rows that its mask spans, or height of the box.
        size_px: Width and height of the picture.
    """
    cues, ranges = vehicle.cues, vehicle.ranges
    if height_px <= 0.0:
        return None
    curve = ranges.stop_sign if label in cues.stop_sign_labels else None
    curve = ranges.traffic_light if label in cues.traffic_light_labels else curve
    if curve is not None:
        return OneRange(float(range_of(np.array([height_px]), curve)[0]), curve.residual_sd_m)
    if is_cut(box_px, size_px) or not _has_defaults(vehicle):
        return None
    found = _by_size(vehicle, label, box_px, height_px, size_px)
    return None if found is None else OneRange(found.mean_m + vehicle.camera.x_m, found.sd_m)


def _has_defaults(vehicle: Vehicle) -> bool:
    ranges = vehicle.ranges
    is_fitted = ranges.stop_sign is not None or ranges.traffic_light is not None
    may = ranges.kind == "motion" or (ranges.kind is None and not is_fitted)
    return may and vehicle.camera.focal_px is not None


def _by_size(
    vehicle: Vehicle,
    label: str,
    box_px: NDArray[np.float64],
    height_px: float,
    size_px: tuple[int, int],
) -> OneRange | None:
    """Depth from the camera, by standard size and for vehicles also by the ground."""
    cues, camera = vehicle.cues, vehicle.camera
    focal_px = camera.focal_px or 0.0
    x0, _, x1, y1 = box_px.tolist()
    if label in cues.traffic_light_labels:
        aspect = height_px / (x1 - x0) if x1 > x0 else None
        return size_range(height_px, focal_px, size_prior("traffic_light", aspect))
    if label in cues.stop_sign_labels:
        return size_range(height_px, focal_px, size_prior("stop_sign"))
    if label not in VEHICLES:
        return None
    slope = GroundPlane.of(camera, size_px).slope(0.5 * (x0 + x1), y1)
    over_ground = GroundCamera(focal_px, camera.z_m, camera.pitch_sd_rad)
    return vehicle_range(slope, height_px, over_ground, VEHICLES[label])
