"""Transform between the device's reference point and the rear axle.

Both frames have x ahead and y to the left (ISO 8855, REP-103). A lane is the cubic
y(x) = c0 + c1 x + c2 x**2 + c3 x**3 from the reference point to the end of the view range.
"""

from dataclasses import dataclass
from math import cos, sin
from typing import Final

import numpy as np

from crosscue.replay.columns import Floats


@dataclass(frozen=True, slots=True)
class DevicePosition:
    """Position and rotation of the device's reference point in the vehicle, from calibration.

    It is also the transform from the device's frame to the vehicle's, and its inverse.

    Attributes:
        x_m: Distance ahead of the rear axle. The device measures from a reference point, not from
            its camera.
        y_m: Distance to the left of the vehicle's centre line.
        yaw_rad: Rotation of the device's axes to the left of the vehicle's axes.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0


AT_REAR_AXLE: Final = DevicePosition()


def device_T_vehicle(mounting: DevicePosition) -> DevicePosition:  # noqa: N802 - frames' names
    """Return the transform from the vehicle's frame to the device's."""
    c, s = cos(mounting.yaw_rad), sin(mounting.yaw_rad)
    x, y = mounting.x_m, mounting.y_m
    return DevicePosition(-(c * x + s * y), s * x - c * y, -mounting.yaw_rad)


def move_points(pose: DevicePosition, x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
    """Transform points from the source frame to the target frame."""
    c, s = cos(pose.yaw_rad), sin(pose.yaw_rad)
    return pose.x_m + c * x_m - s * y_m, pose.y_m + s * x_m + c * y_m


def move_cubic(pose: DevicePosition, c: Floats) -> Floats:
    """Transform cubics from the source frame to the target frame.

    A rotated cubic is not a cubic; it is expanded to third order about its start. For rotations of
    a few degrees the error is far below a step of the wire; without rotation the result is exact.

    Args:
        pose: ``target_T_source``.
        c: Coefficients c0 to c3, shape (4, N).
    """
    if pose.yaw_rad == 0.0:
        return _shift(np.vstack([c[:1] + pose.y_m, c[1:]]), pose.x_m)
    co, si = cos(pose.yaw_rad), sin(pose.yaw_rad)
    # x = x0 + a1 s + a2 s^2 + a3 s^3 along the cubic, y likewise with b; invert x, insert in y.
    a1, a2, a3 = co - si * c[1], -si * c[2], -si * c[3]
    b1, b2, b3 = si + co * c[1], co * c[2], co * c[3]
    s1, s2, s3 = 1 / a1, -a2 / a1**3, (2 * a2**2 - a1 * a3) / a1**5
    turned = np.vstack(
        [
            pose.y_m + co * c[0],
            b1 * s1,
            b1 * s2 + b2 * s1**2,
            b1 * s3 + 2 * b2 * s1 * s2 + b3 * s1**3,
        ]
    )
    return _shift(turned, pose.x_m - si * c[0])


def _shift(c: Floats, x0_m: float | Floats) -> Floats:
    """Convert a cubic in x - x0 to a cubic in x."""
    return np.vstack(
        [
            c[0] - x0_m * (c[1] - x0_m * (c[2] - x0_m * c[3])),
            c[1] - x0_m * (2 * c[2] - 3 * x0_m * c[3]),
            c[2] - 3 * x0_m * c[3],
            c[3],
        ]
    )


def turn_slope(yaw_rad: float, c1: Floats, c2_per_m: Floats) -> tuple[Floats, Floats]:
    """Return slope and half curvature of a line at a point, in axes rotated by -``yaw_rad``."""
    if yaw_rad == 0.0:
        return c1, c2_per_m
    co, si = cos(yaw_rad), sin(yaw_rad)
    along = co - si * c1
    return (si + co * c1) / along, c2_per_m / along**3


def evaluate(c: Floats, x_m: Floats) -> Floats:
    """Return the values of cubics of shape (4, N) at ``x_m``."""
    y: Floats = c[0] + x_m * (c[1] + x_m * (c[2] + x_m * c[3]))
    return y
