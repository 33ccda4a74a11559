"""Estimate the pose at the start of a drive from its first known positions."""

import math
from typing import Final, NamedTuple

import numpy as np

from crosscue.replay.columns import Floats, Int64s

from .angles import wrap
from .fixes import Fixes
from .odometry import Increments
from .pose_filter import State

# Duration of the start of the drive that is used.
START_S: Final = 15.0
# Time over which positions count as one observation, because GNSS errors persist.
INDEPENDENT_S: Final = 1.0


class Path(NamedTuple):
    """Dead reckoning from pose (0, 0, 0), as arrays of shape (N,)."""

    x_m: Floats
    y_m: Floats
    heading_rad: Floats


def path_of(increments: Increments, at_ns: Int64s, begin_ns: int) -> Path:
    """Compute poses relative to the one at ``begin_ns``; linear inside increments."""
    heading = np.append(0.0, np.cumsum(increments.turn_rad))
    half = 0.5 * increments.turn_rad
    chord = increments.distance_m * np.sinc(half / np.pi)
    x = np.append(0.0, np.cumsum(chord * np.cos(heading[:-1] + half)))
    y = np.append(0.0, np.cumsum(chord * np.sin(heading[:-1] + half)))
    edges = np.append(increments.start_ns[:1], increments.stop_ns)
    at_s = (np.append(begin_ns, at_ns) - edges[0]) * 1e-9
    x, y, heading = (np.interp(at_s, (edges - edges[0]) * 1e-9, c) for c in (x, y, heading))
    cos, sin = math.cos(heading[0]), math.sin(heading[0])
    dx, dy = x[1:] - x[0], y[1:] - y[0]
    return Path(cos * dx + sin * dy, cos * dy - sin * dx, heading[1:] - heading[0])


def start_pose(
    increments: Increments, fixes: Fixes, lever_m: tuple[float, float], at_ns: int | None = None
) -> State:
    """Estimate the pose of the rear axle by aligning the first seconds' odometry with the fixes.

    This is the planar case of S. Umeyama (PAMI 13, 1991) without scale. The covariance follows from
    the fixes' covariances, or from the residuals if these are larger. The heading of a car that
    does not move remains unknown.

    Args:
        increments: Odometry that covers the first seconds of fixes.
        fixes: At least one fix, in order.
        lever_m: Point of the fixes, ahead of and to the left of the rear axle.
        at_ns: Time of the pose; None for the first fix.
    """
    first = fixes.take(fixes.t_ns <= fixes.t_ns[0] + round(START_S * 1e9))
    begin_ns = int(first.t_ns[0]) if at_ns is None else at_ns
    path = path_of(increments, first.t_ns, begin_ns)
    driven = path.x_m + 1j * path.y_m + np.exp(1j * path.heading_rad) * complex(*lever_m)
    seen = first.xy_m[:, 0] + 1j * first.xy_m[:, 1]
    middle, to = driven.mean(), seen.mean()
    match = np.vdot(driven - middle, seen - to)
    heading = float(np.angle(match))
    turned = complex(np.exp(1j * heading))
    apart = seen - to - turned * (driven - middle)
    var = float(np.mean(np.trace(first.cov_m2, axis1=1, axis2=2))) / 2.0
    var = max(var, float(np.sum(np.abs(apart) ** 2)) / max(2 * len(first) - 3, 1))
    reach = float(np.mean(np.abs(driven - middle) ** 2))
    independent = 1.0 + (int(first.t_ns[-1]) - int(first.t_ns[0])) * 1e-9 / INDEPENDENT_S
    heading_var = var / max(reach * min(independent, float(len(first))), 1e-12)
    inside = increments.stop_ns <= first.t_ns[-1]
    heading_var += float(increments.turn_var_rad2[inside].sum()) / 3.0
    heading_var = min(heading_var, math.pi**2)
    # The fixes fix the path at their centre, and the heading's error rotates the start about it.
    arm = -turned * middle
    at = to + arm
    return State(
        x_m=at.real,
        y_m=at.imag,
        heading_rad=wrap(heading),
        speed_mps=0.0,
        xx=var + arm.imag**2 * heading_var,
        xy=-arm.real * arm.imag * heading_var,
        xh=-arm.imag * heading_var,
        xv=0.0,
        yy=var + arm.real**2 * heading_var,
        yh=arm.real * heading_var,
        yv=0.0,
        hh=heading_var,
        hv=0.0,
        vv=0.0,
    )
