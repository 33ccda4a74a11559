"""Batch smoother of the pose over all of the filter's measurements.

It is a factor graph of planar poses (F. Dellaert, M. Kaess, "Factor Graphs for Robot Perception",
2017), solved by GTSAM, an optional package. Odometry connects the poses, headings and landmarks are
measurements of them, and the start is the prior. Unlike the filter, the smoother also uses later
measurements, and it linearises about its solution. It is a reference, not a part of the replay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Final

import numpy as np

from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import UsageError

from .angles import wrap
from .ekf import PoseBelief
from .fixes import NO_FIXES, Fixes
from .odometry import BY_NOTHING, Increments
from .pose_filter import State, predict_pose
from .pose_track import Headings

if TYPE_CHECKING:
    import gtsam

# Maximum time between two poses of the graph.
STEP_NS: Final = 1_000_000_000
# Variance added to make the covariance of an arc, which has no sideways error, invertible: 3 mm and
# 0.1 mrad.
_MIN_VARIANCE: Final = np.diag([1e-5, 1e-5, 1e-8])
RELATIVE_TOLERANCE: Final = 1e-10
ABSOLUTE_TOLERANCE: Final = 1e-6
_AT_REST: Final = State(*(0.0,) * len(State._fields))


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """M smoothed poses.

    Attributes:
        t_ns: Shape (M,), int64.
        xyh: Shape (M, 3): x, y in metres, heading in radians in (-pi, pi].
        cov: Shape (M, 3, 3), in the map frame.
    """

    t_ns: Int64s
    xyh: Floats
    cov: Floats


def smooth_poses(
    start: PoseBelief,
    increments: Increments,
    headings: Headings,
    fixes: Fixes = NO_FIXES,
    at_ns: Int64s | None = None,
    lever_m: Floats | tuple[float, float] = (0.0, 0.0),
) -> Smoothed:
    """Compute the poses that fit all measurements best.

    Args:
        start: The first belief, at whose time the graph starts.
        increments: Odometry without gaps, from the start's time on.
        headings: Headings in use, with their variances.
        fixes: Landmarks and GNSS positions in use.
        at_ns: Requested times; None for the graph's own, at most ``STEP_NS`` apart. Times outside
            the odometry are left out.
        lever_m: Point of the car whose positions the fixes are, ahead of and to the left of the
            rear axle: one point, or shape (N, 2).

    Raises:
        UsageError: GTSAM is not installed.
        ValueError: The odometry has a gap or is empty.
    """
    _need_gtsam()
    import gtsam

    _check(start, increments)
    times = _times(start, increments, headings, fixes, at_ns)
    graph, guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
    _add_start(graph, start)
    steps = _steps(times, increments)
    for key, (mean, cov) in enumerate(steps, start=1):
        noise = gtsam.noiseModel.Gaussian.Covariance(_in_end_frame(cov, mean[2]))
        graph.add(gtsam.BetweenFactorPose2(key - 1, key, gtsam.Pose2(*mean), noise))
    for key, pose in enumerate(_guessed(start, times, steps, headings)):
        guess.insert(key, gtsam.Pose2(*pose))
    _add_headings(graph, times, headings)
    _add_fixes(graph, guess, times, fixes, lever_m)
    solved = _solved(graph, guess)
    return _read(graph, solved, times, times if at_ns is None else at_ns)


def _need_gtsam() -> None:
    try:
        import_module("gtsam")
    except ImportError:
        raise UsageError(
            "the smoother needs the package gtsam; install it with: pip install gtsam"
        ) from None


def _check(start: PoseBelief, increments: Increments) -> None:
    if not len(increments) or increments.stop_ns[-1] <= start.t_ns:
        raise ValueError(f"increments: expected odometry after {start.t_ns} ns, got none")
    holes = np.flatnonzero(increments.start_ns[1:] != increments.stop_ns[:-1])
    if len(holes) or increments.start_ns[0] > start.t_ns:
        where = increments.stop_ns[holes[0]] if len(holes) else start.t_ns
        raise ValueError(f"increments: expected no gaps, got one at {where} ns")


def _times(
    start: PoseBelief,
    increments: Increments,
    headings: Headings,
    fixes: Fixes,
    at_ns: Int64s | None,
) -> Int64s:
    end_ns = int(increments.stop_ns[-1])
    wanted = [headings.t_ns, fixes.t_ns, np.arange(start.t_ns, end_ns, STEP_NS)]
    wanted += [np.array([start.t_ns, end_ns])] + ([] if at_ns is None else [at_ns])
    times = np.unique(np.concatenate(wanted)).astype(np.int64)
    inside: Int64s = times[(times >= start.t_ns) & (times <= end_ns)]
    return inside


def _steps(times: Int64s, increments: Increments) -> list[tuple[Floats, Floats]]:
    """Relative poses between successive times, with covariances, in the earlier pose's frame."""
    columns = (
        increments.distance_m,
        increments.turn_rad,
        increments.distance_var_m2,
        increments.turn_var_rad2,
    )
    is_blind = increments.turn_source == BY_NOTHING
    starts, stops = increments.start_ns.tolist(), increments.stop_ns.tolist()
    rows = list(zip(*(column.tolist() for column in columns), strict=True))
    i = int(np.searchsorted(increments.stop_ns, times[0], side="right"))
    steps: list[tuple[Floats, Floats]] = []
    now = int(times[0])
    for until in times[1:].tolist():
        state, aside_var = _AT_REST, 0.0
        while now < until:
            to = min(until, stops[i])
            fraction = (to - now) / (stops[i] - starts[i])
            distance, turn, distance_var, turn_var = (fraction * value for value in rows[i])
            state = predict_pose(state, distance, turn, distance_var, turn_var, 0.0)
            aside_var += distance_var if is_blind[i] else 0.0
            now = to
            i += now == stops[i]
        x, y, heading, _, xx, xy, xh, _, yy, yh, _, hh, _, _ = state
        # In a gap the error to the side is as large as that ahead.
        cov = np.array([[xx, xy, xh], [xy, yy + aside_var, yh], [xh, yh, hh]])
        steps.append((np.array([x, y, heading]), cov))
    return steps


def _guessed(
    start: PoseBelief, times: Int64s, steps: list[tuple[Floats, Floats]], headings: Headings
) -> list[tuple[float, float, float]]:
    """Compute initial poses from odometry, with headings corrected as in a filter.

    Odometry alone is radians and kilometres off after hours, and no solver converges from there.
    """
    read = dict(
        zip(
            headings.t_ns.tolist(),
            zip(headings.heading_rad.tolist(), headings.var_rad2.tolist(), strict=True),
            strict=True,
        )
    )
    x, y, heading = (float(value) for value in start.mean[:3])
    var = float(start.cov[2, 2])
    poses = [(x, y, heading)]
    for t_ns, (mean, cov) in zip(times[1:].tolist(), steps, strict=True):
        c, s = math.cos(heading), math.sin(heading)
        x, y = x + c * mean[0] - s * mean[1], y + s * mean[0] + c * mean[1]
        heading, var = heading + mean[2], var + float(cov[2, 2])
        if t_ns in read:
            seen, seen_var = read[t_ns]
            gain = var / (var + seen_var)
            heading, var = heading + gain * wrap(seen - heading), var * (1.0 - gain)
        poses.append((x, y, heading))
    return poses


def _solved(graph: gtsam.NonlinearFactorGraph, guess: gtsam.Values) -> gtsam.Values:
    """Optimise the graph.

    The position in a long drive is determined so weakly that an error of 100 m changes the total
    error by a thousandth. GTSAM's default tolerances stop before the minimum is reached.
    """
    import gtsam

    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(RELATIVE_TOLERANCE)
    params.setAbsoluteErrorTol(ABSOLUTE_TOLERANCE)
    params.setLinearSolverType("MULTIFRONTAL_QR")
    return gtsam.LevenbergMarquardtOptimizer(graph, guess, params).optimize()


def _rotation(angle_rad: float) -> Floats:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _in_end_frame(cov: Floats, turn_rad: float) -> Floats:
    """Rotate a covariance to the axes of the later pose, as in GTSAM."""
    back = _rotation(-turn_rad)
    turned: Floats = back @ cov @ back.T + _MIN_VARIANCE
    return turned


def _add_start(graph: gtsam.NonlinearFactorGraph, start: PoseBelief) -> None:
    import gtsam

    cov = _in_end_frame(start.cov[:3, :3], float(start.mean[2]))
    noise = gtsam.noiseModel.Gaussian.Covariance(cov)
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*start.mean[:3]), noise))


def _add_headings(graph: gtsam.NonlinearFactorGraph, times: Int64s, headings: Headings) -> None:
    import gtsam

    for t_ns, heading, var in zip(
        headings.t_ns.tolist(),
        headings.heading_rad.tolist(),
        headings.var_rad2.tolist(),
        strict=True,
    ):
        key = int(np.searchsorted(times, t_ns))
        if key == len(times) or times[key] != t_ns:
            continue
        noise = gtsam.noiseModel.Isotropic.Sigma(1, math.sqrt(var))
        graph.add(gtsam.PoseRotationPrior2D(key, gtsam.Rot2(heading), noise))


def _add_fixes(
    graph: gtsam.NonlinearFactorGraph,
    guess: gtsam.Values,
    times: Int64s,
    fixes: Fixes,
    lever_m: Floats | tuple[float, float],
) -> None:
    """Add each fix as a measurement of a camera or antenna pose, rigidly connected to the car's."""
    import gtsam

    levers_m = np.broadcast_to(np.asarray(lever_m, np.float64), (len(fixes), 2))
    rigid = gtsam.noiseModel.Gaussian.Covariance(_MIN_VARIANCE)
    for i, t_ns in enumerate(fixes.t_ns.tolist()):
        key = int(np.searchsorted(times, t_ns))
        if key == len(times) or times[key] != t_ns:
            continue
        ahead_m, left_m = levers_m[i].tolist()
        lever = gtsam.Pose2(ahead_m, left_m, 0.0)
        point = len(times) + i
        guess.insert(point, guess.atPose2(key).compose(lever))
        graph.add(gtsam.BetweenFactorPose2(key, point, lever, rigid))
        noise = gtsam.noiseModel.Gaussian.Covariance(fixes.cov_m2[i])
        graph.add(gtsam.PoseTranslationPrior2D(point, fixes.xy_m[i], noise))


def _read(
    graph: gtsam.NonlinearFactorGraph, solved: gtsam.Values, times: Int64s, at_ns: Int64s
) -> Smoothed:
    import gtsam

    # On a long drive, rounding in gtsam.Marginals (Cholesky) loses the position's information.
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    marginals = gtsam.ISAM2(params)
    marginals.update(graph, solved)
    found = at_ns[(at_ns >= times[0]) & (at_ns <= times[-1])]
    xyh, covs = np.empty((len(found), 3)), np.empty((len(found), 3, 3))
    for row, key in enumerate(np.searchsorted(times, found).tolist()):
        pose = solved.atPose2(key)
        xyh[row] = pose.x(), pose.y(), wrap(pose.theta())
        out = _rotation(pose.theta())
        covs[row] = out @ marginals.marginalCovariance(key) @ out.T
    return Smoothed(found, xyh, covs)
