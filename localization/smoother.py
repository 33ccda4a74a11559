"""Batch smoother of the pose over all of the filter's measurements.

Odometry connects the poses, headings and landmarks are measurements of them, and the start is the
prior. Constant errors of the odometry are states, as in the filter. Unlike the filter, the smoother
also uses later measurements, and it linearises about its solution: it is an iterated Kalman
smoother, which is Gauss and Newton's method for the most likely track (B. Bell, *The Iterated
Kalman Smoother as a Gauss-Newton Method*, SIAM J. Optimization 4, 1994). The backward pass is
Bryson and Frazier's (Bierman, *Factorization Methods for Discrete Sequential Estimation*, 1977,
chapter 10), which inverts only covariances of measurements. It is a reference, not a part of the
replay.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from crosscue.replay.columns import Floats, Int64s

from .angles import wrap_all
from .constants import NO_CONSTANTS, Constants
from .ekf import PoseBelief, odometry_derivatives
from .fixes import NO_FIXES, Fixes
from .odometry import BY_NOTHING, Increments
from .pose_filter import HEADING, State, predict_pose
from .pose_track import Headings

# Maximum time between two poses of the track.
STEP_NS: Final = 1_000_000_000
# Change of any state below which the iteration ends, and the maximum number of passes.
SETTLED: Final = 1e-7
PASSES: Final = 30
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
    errors: tuple[Constants, Floats] | None = None,
) -> Smoothed:
    """Compute the poses that fit all measurements best.

    Args:
        start: The first belief, at whose time the track starts.
        increments: Odometry without gaps, from the start's time on.
        headings: Headings in use, with their variances.
        fixes: Landmarks and GNSS positions in use.
        at_ns: Requested times; None for the track's own, at most ``STEP_NS`` apart. Times outside
            the odometry are left out.
        lever_m: Point of the car whose positions the fixes are, ahead of and to the left of the
            rear axle: one point, or shape (N, 2).
        errors: K constant errors of the odometry at the start, and their ``effects`` on the
            increments, shape (N, 2, K).

    Raises:
        ValueError: The odometry has a gap or is empty.
    """
    _check(start, increments)
    times = _times(start, increments, headings, fixes, at_ns)
    constants, by = errors or (NO_CONSTANTS, np.zeros((len(increments), 2, 0)))
    steps = _steps(times, increments, by)
    seen = _measured(times, headings, fixes, lever_m)
    rows = slice(0, 3)
    mean = np.append(start.mean[rows], constants.mean)
    cross = constants.cross[rows]
    cov = np.block([[start.cov[rows, rows], cross], [cross.T, constants.cov]])
    drift = np.append(np.zeros(3), constants.drift_var_per_s)
    found, covs = _passed(mean, cov, steps, drift, seen, None)
    for _ in range(PASSES):
        before = found
        found, covs = _passed(mean, cov, steps, drift, seen, before)
        if float(np.abs(found - before).max()) < SETTLED:
            break
    kept = times if at_ns is None else at_ns[(at_ns >= times[0]) & (at_ns <= times[-1])]
    at = np.searchsorted(times, kept)
    xyh = found[at, :3]
    xyh[:, HEADING] = wrap_all(xyh[:, HEADING])
    return Smoothed(kept, xyh, covs[at])


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


class _Step(NamedTuple):
    """Motion between two times, in the earlier pose's frame, and its derivatives by constants."""

    mean: Floats
    cov: Floats
    by: Floats
    dt_s: float


def _steps(times: Int64s, increments: Increments, by: Floats) -> list[_Step]:
    """Return the motion between successive times."""
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
    steps: list[_Step] = []
    now = int(times[0])
    for until in times[1:].tolist():
        begin, state, aside_var, effect = now, _AT_REST, 0.0, np.zeros((3, by.shape[2]))
        while now < until:
            to = min(until, stops[i])
            fraction = (to - now) / (stops[i] - starts[i])
            distance, turn, distance_var, turn_var = (fraction * value for value in rows[i])
            if effect.size:
                by_state, by_input = odometry_derivatives(
                    state.heading_rad, distance, turn, fraction * by[i]
                )
                effect = by_state[:3, :3] @ effect + by_input[:3]
            state = predict_pose(state, distance, turn, distance_var, turn_var, 0.0)
            aside_var += distance_var if is_blind[i] else 0.0
            now = to
            i += now == stops[i]
        x, y, heading, _, xx, xy, xh, _, yy, yh, _, hh, _, _ = state
        # In a gap the error to the side is as large as that ahead.
        cov = np.array([[xx, xy, xh], [xy, yy + aside_var, yh], [xh, yh, hh]])
        steps.append(_Step(np.array([x, y, heading]), cov, effect, (until - begin) * 1e-9))
    return steps


class _Seen(NamedTuple):
    """A heading, or the position of a point of the car."""

    value: Floats
    cov: Floats
    lever_m: tuple[float, float] | None

    def expected(self, at: Floats) -> tuple[Floats, Floats]:
        """Return the expected value at a state, and its derivatives, shape (1 or 2, 3)."""
        if self.lever_m is None:
            return at[HEADING : HEADING + 1], np.array([[0.0, 0.0, 1.0]])
        ahead_m, left_m = self.lever_m
        c, s = math.cos(at[HEADING]), math.sin(at[HEADING])
        dx_m, dy_m = c * ahead_m - s * left_m, s * ahead_m + c * left_m
        by = np.array([[1.0, 0.0, -dy_m], [0.0, 1.0, dx_m]])
        return at[:2] + np.array([dx_m, dy_m]), by


def _measured(
    times: Int64s, headings: Headings, fixes: Fixes, lever_m: Floats | tuple[float, float]
) -> list[list[_Seen]]:
    """Return the measurements at each time."""
    found: list[list[_Seen]] = [[] for _ in times]
    levers_m = np.broadcast_to(np.asarray(lever_m, np.float64), (len(fixes), 2))
    some: list[tuple[int, _Seen]] = []
    columns = headings.t_ns.tolist(), headings.heading_rad.tolist(), headings.var_rad2.tolist()
    for t_ns, heading, var in zip(*columns, strict=True):
        some.append((t_ns, _Seen(np.array([heading]), np.array([[var]]), None)))
    for i, t_ns in enumerate(fixes.t_ns.tolist()):
        ahead_m, left_m = levers_m[i].tolist()
        some.append((t_ns, _Seen(fixes.xy_m[i], fixes.cov_m2[i], (ahead_m, left_m))))
    for t_ns, one in some:
        row = int(np.searchsorted(times, t_ns))
        if row < len(times) and times[row] == t_ns:
            found[row].append(one)
    return found


def _passed(
    mean: Floats,
    cov: Floats,
    steps: Sequence[_Step],
    drift_var_per_s: Floats,
    seen: Sequence[Sequence[_Seen]],
    about: Floats | None,
) -> tuple[Floats, Floats]:
    """Filter forwards and smooth backwards, linear about a track (None: about the filter's own).

    Returns:
        States, shape (M, 3 + K), with headings not wrapped, and covariances of the poses.
    """
    n, eye = len(mean), np.eye(len(mean))
    means: list[Floats] = []
    covs: list[Floats] = []
    motions = [eye]
    updates: list[list[tuple[Floats, Floats, Floats]]] = []
    for row, measured in enumerate(seen):
        if row:
            step = steps[row - 1]
            at = mean if about is None else about[row - 1]
            to, motion, turned = _moved(at, step)
            mean = to + motion @ (mean - at)
            noise = np.diag(drift_var_per_s * step.dt_s)
            noise[:3, :3] += turned @ step.cov @ turned.T
            cov = motion @ cov @ motion.T + noise
            motions.append(motion)
        done = []
        for one in measured:
            at = mean if about is None else about[row]
            expected, by_pose = one.expected(at)
            by = np.zeros((len(expected), n))
            by[:, :3] = by_pose
            off = one.value - expected - by @ (mean - at)
            off = wrap_all(off) if one.lever_m is None else off
            weight = np.linalg.inv(by @ cov @ by.T + one.cov)
            gain = cov @ by.T @ weight
            mean, cov = mean + gain @ off, cov - gain @ by @ cov
            cov = 0.5 * (cov + cov.T)
            done.append((eye - gain @ by, by.T @ weight @ off, by.T @ weight @ by))
        means.append(mean)
        covs.append(cov)
        updates.append(done)
    pull, information = np.zeros(n), np.zeros((n, n))
    smoothed, spread = np.empty((len(seen), n)), np.empty((len(seen), 3, 3))
    for row in reversed(range(len(seen))):
        mean, cov = means[row], covs[row]
        smoothed[row] = mean - cov @ pull
        spread[row] = (cov - cov @ information @ cov)[:3, :3]
        for kept, told, known in reversed(updates[row]):
            pull = kept.T @ pull - told
            information = kept.T @ information @ kept + known
        pull = motions[row].T @ pull
        information = motions[row].T @ information @ motions[row]
    return smoothed, spread


def _moved(at: Floats, step: _Step) -> tuple[Floats, Floats, Floats]:
    """Return the state after a step, its derivatives by the state before, and the rotation."""
    c, s = math.cos(at[HEADING]), math.sin(at[HEADING])
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = turned @ (step.mean + step.by @ at[3:])
    motion = np.eye(len(at))
    motion[:2, HEADING] = -moved[1], moved[0]
    motion[:3, 3:] = turned @ step.by
    after = at.copy()
    after[:3] += moved
    return after, motion, turned
