"""Range of a single detection: by a fitted curve, or by standard sizes and the ground.

Curves are set in the vehicle file. Without a curve, and with ``camera.focal_px``, the default range
of lights, signs and vehicles is R = f H / h with their standard size; for vehicles it is combined
with the ground's. The standard deviation includes the spread of sizes. ``ranges.kind = "curve"``
disables the defaults.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.vehicle.vehicle import Vehicle

from .ground_plane import GroundPlane
from .height_to_range import range_of
from .standard_sizes import VEHICLES, size_prior
from .usable import are_cut
from .vehicle_range import GroundCamera, OneRange, size_range, vehicle_range


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
    if not _has_defaults(vehicle) or are_cut(box_px[None], size_px)[0]:
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
    foot = np.array([[0.5 * (x0 + x1), y1]])
    ((ahead, _, up),) = GroundPlane.of(camera, size_px).rays(foot).tolist()
    over_ground = GroundCamera(focal_px, camera.z_m, camera.pitch_sd_rad)
    return vehicle_range(-up / ahead, height_px, over_ground, VEHICLES[label])
