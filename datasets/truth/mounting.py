"""Where the body whose track a truth file carries sits on the car."""

from __future__ import annotations

from typing import NamedTuple

from crosscue.replay.vehicle.vehicle import Vehicle

from .truth import Truth


class PlaneMounting(NamedTuple):
    """A body's pose seen from the rear axle, in the ground plane.

    Attributes:
        x_m: Ahead.
        y_m: To the left.
        yaw_rad: Counter-clockwise.
    """

    x_m: float
    y_m: float
    yaw_rad: float


def mounting_of(truth: Truth, vehicle: Vehicle) -> PlaneMounting:
    """What the truth file says of it, else what the vehicle file does."""
    given = truth.mounting
    if given is not None:
        return PlaneMounting(given.x_m, given.y_m, given.yaw_rad)
    if truth.pose_point == "camera":
        camera = vehicle.camera
        return PlaneMounting(camera.x_m, camera.y_m, camera.yaw_rad)
    if truth.pose_point == "antenna":
        return PlaneMounting(vehicle.gnss.x_m, vehicle.gnss.y_m, 0.0)
    return PlaneMounting(0.0, 0.0, 0.0)
