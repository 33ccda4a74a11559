"""Beliefs on the pose, and their errors along arcs."""

import math

import numpy as np
from numpy.typing import NDArray

from crosscue.localization.angles import wrap
from crosscue.localization.ekf import PoseBelief, pack_belief, unpack_belief
from crosscue.localization.pose_filter import (
    HEADING,
    SPEED,
    predict_pose,
    update_position,
    update_state,
)
from crosscue.replay.columns import Floats


def driven(
    belief: PoseBelief,
    distance_m: float,
    turn_rad: float,
    variances: tuple[float, float, float] = (0.0, 0.0, 0.0),
    dt_s: float = 1.0,
) -> PoseBelief:
    """Predict along an arc; variances of distance, of turn, and of the speed at the end."""
    after = predict_pose(pack_belief(belief), distance_m, turn_rad, *variances)
    return unpack_belief(belief.t_ns + round(dt_s * 1e9), after)


def with_heading(belief: PoseBelief, heading_rad: float, var_rad2: float) -> PoseBelief:
    """Update with a heading."""
    innovation = wrap(heading_rad - float(belief.mean[HEADING]))
    after = update_state(pack_belief(belief), HEADING, innovation, var_rad2)
    return unpack_belief(belief.t_ns, after)


def with_speed(belief: PoseBelief, speed_mps: float, var_m2ps2: float) -> PoseBelief:
    """Update with a speed."""
    innovation = speed_mps - float(belief.mean[SPEED])
    return unpack_belief(
        belief.t_ns, update_state(pack_belief(belief), SPEED, innovation, var_m2ps2)
    )


def with_position(belief: PoseBelief, xy_m: Floats, cov_m2: Floats) -> PoseBelief:
    """Update with a position."""
    (xx, xy), (_, yy) = cov_m2.tolist()
    x_m, y_m = np.asarray(xy_m, np.float64).tolist()
    after = update_position(pack_belief(belief), x_m, y_m, xx, xy, yy, math.inf)
    return unpack_belief(belief.t_ns, after.state)


def joseph(
    belief: PoseBelief, xy_m: Floats, cov_m2: Floats, lever_m: tuple[float, float]
) -> PoseBelief:
    """Update with a position, linear in the heading (Bar-Shalom et al., eq. 5.2.3-18)."""
    c, s = math.cos(belief.mean[HEADING]), math.sin(belief.mean[HEADING])
    offset = np.array([c * lever_m[0] - s * lever_m[1], s * lever_m[0] + c * lever_m[1]])
    observe = np.eye(2, 4)
    observe[:, HEADING] = -offset[1], offset[0]
    spread = observe @ belief.cov @ observe.T + cov_m2
    gain = np.linalg.solve(spread, observe @ belief.cov).T
    keep = np.eye(4) - gain @ observe
    mean = belief.mean + gain @ (xy_m - belief.mean[:2] - offset)
    mean[HEADING] = wrap(float(mean[HEADING]))
    return PoseBelief(belief.t_ns, mean, keep @ belief.cov @ keep.T + gain @ cov_m2 @ gain.T)


def nees_along_the_arc(row: NDArray[np.float64]) -> float:
    """Return the NEES of the rigid motion from the estimate to the truth.

    It is consistent for errors along an arc (Long, Wolfe, Mashner, Chirikjian, *The banana
    distribution is Gaussian*, RSS 2012).

    Args:
        row: Shape (16,): one row of ``Traced.steps``.
    """
    x, y, heading = row[:3]
    at_x, at_y, at_heading = row[7:10]
    xx, xy, xh, yy, yh, hh = row[10:16]
    cov = np.array([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]])
    turn = wrap(heading - at_heading)
    half = 0.5 * turn
    along = half / math.tan(half) if half else 1.0
    dx, dy = x - at_x, y - at_y
    # In the frame of the estimate, the motion has the covariance of the pose.
    error = np.array([along * dx + half * dy, along * dy - half * dx, turn])
    return float(error @ np.linalg.solve(cov, error))
