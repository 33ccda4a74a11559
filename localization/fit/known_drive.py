"""A drive with known positions: odometry between them, and a filter with or without updates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from crosscue.localization.constants import NO_CONSTANTS, Constants, effects
from crosscue.localization.ekf import unpack_belief
from crosscue.localization.fixes import Fixes
from crosscue.localization.odometry import (
    Increments,
    OdometrySettings,
    TurnSignal,
    WheelSamples,
    integrate,
)
from crosscue.localization.pose_filter import State, arc
from crosscue.localization.start_pose import start_pose
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.compiled import kept

# Maximum duration of an arc of odometry.
STEP_S: Final = 0.2
# Time at both ends that signals keep for the fitted delays.
MARGIN_S: Final = 0.3
# Normalised innovation squared beyond which a position has less weight; one good position in a
# thousand exceeds it.
GATE_NIS: Final = 13.8


class Steps(NamedTuple):
    """M arcs of odometry between positions.

    Attributes:
        at_fix: Shape (M,): index of the position at the arc's end, or -1.
        distance_m: Shape (M,).
        turn_rad: Shape (M,).
        distance_var_m2: Shape (M,).
        turn_var_rad2: Shape (M,).
        wander_var_m2: Shape (M,): growth of the variance of the positions' own error, per axis.
        by: Shape (M, 2, K): derivatives of distance and turn by parameters that are states.
        drift_var: Shape (M, K): growth of these parameters' variances.
    """

    at_fix: Int64s
    distance_m: Floats
    turn_rad: Floats
    distance_var_m2: Floats
    turn_var_rad2: Floats
    wander_var_m2: Floats
    by: Floats
    drift_var: Floats


class Predicted(NamedTuple):
    """Predictions of a filter for N positions, before their updates.

    Attributes:
        xy_m: Shape (N, 2).
        heading_rad: Shape (N,).
        cov_m2: Shape (N, 2, 2).
    """

    xy_m: Floats
    heading_rad: Floats
    cov_m2: Floats


class Car(NamedTuple):
    """A car and the positions that are known of it.

    Attributes:
        settings: Odometry settings.
        constants: Errors of the settings.
        delay_s: Delay of the positions' timestamps.
        fix_sd_m: S.d. of the positions.
        wander_m_per_sqrt_s: S.d. of the change of the positions' own error in one second.
    """

    settings: OdometrySettings
    constants: Constants = NO_CONSTANTS
    delay_s: float = 0.0
    fix_sd_m: float = 0.0
    wander_m_per_sqrt_s: float = 0.0


class KnownDrive:
    """Wheel speeds, a turn signal, and positions while both are available."""

    def __init__(
        self,
        wheels: WheelSamples,
        turn: TurnSignal | None,
        fixes: Fixes,
        lever_m: tuple[float, float],
    ) -> None:
        """Select the positions that are within the odometry.

        Args:
            wheels: The drive's wheel speeds.
            turn: Yaw rate or steering; None uses the wheels' difference.
            fixes: Positions in order of time.
            lever_m: Point of the positions, ahead of and to the left of the rear axle.
        """
        self.wheels, self.turn, self.lever_m = wheels, turn, lever_m
        self.source = "wheels" if turn is None else turn.kind
        self.fixes = fixes = _covered(wheels, turn, fixes)
        self.seconds = (fixes.t_ns - fixes.t_ns[0]) * 1e-9 if len(fixes) else np.empty(0)
        knots, at = [np.zeros(1)], [np.zeros(1, np.int64)]
        for k, (before, after) in enumerate(
            zip(self.seconds[:-1].tolist(), self.seconds[1:].tolist(), strict=True), start=1
        ):
            parts = max(math.ceil((after - before) / STEP_S), 1)
            knots.append(np.linspace(before, after, parts + 1)[1:])
            at.append(np.array([-1] * (parts - 1) + [k]))
        self.knots_s, self.at_fix = np.concatenate(knots), np.concatenate(at)
        self.dt_s = np.diff(self.knots_s, prepend=0.0)

    @property
    def fix_sd_m(self) -> float:
        """Mean stated s.d. of the positions, per axis."""
        return math.sqrt(float(np.mean(np.trace(self.fixes.cov_m2, axis1=1, axis2=2))) / 2.0)

    def until(self, t_ns: int) -> KnownDrive:
        """Return the drive with only the positions before a time."""
        before = self.fixes.take(self.fixes.t_ns < t_ns)
        return KnownDrive(self.wheels, self.turn, before, self.lever_m)

    def steps(
        self,
        settings: OdometrySettings,
        delay_s: float = 0.0,
        wander_m_per_sqrt_s: float = 0.0,
        names: tuple[str, ...] = (),
        drift_var_per_s: Sequence[float] | Floats = (),
    ) -> Steps:
        """Compute the odometry between the positions.

        Args:
            settings: Odometry settings of the car.
            delay_s: Delay of the positions' timestamps.
            wander_m_per_sqrt_s: S.d. of the change of the positions' own error in one second.
            names: K parameters whose deviations are states.
            drift_var_per_s: Growth of their variances per second, shape (K,).
        """
        made = self.increments(settings)
        columns = made.distance_m, made.turn_rad, made.distance_var_m2, made.turn_var_rad2
        summed = (self._between(made, column, delay_s) for column in columns)
        wander_var_m2 = wander_m_per_sqrt_s**2 * self.dt_s
        by = effects(made, settings, names)
        between = [self._between(made, column, delay_s) for column in by.reshape(len(by), -1).T]
        arcs = np.array(between).reshape(2, len(names), len(self.knots_s)).transpose(2, 0, 1)
        drift_var = np.outer(self.dt_s, drift_var_per_s)
        way_m, turn_rad, way_var_m2, turn_var_rad2 = summed
        return Steps(
            self.at_fix, way_m, turn_rad, way_var_m2, turn_var_rad2, wander_var_m2, arcs, drift_var
        )

    def _between(self, made: Increments, column: Floats, delay_s: float) -> Floats:
        """Sum a column of increments over each arc."""
        edges_s = (np.append(made.start_ns[:1], made.stop_ns) - self.fixes.t_ns[0]) * 1e-9
        sums = np.interp(self.knots_s - delay_s, edges_s, np.append(0.0, np.cumsum(column)))
        return np.diff(sums, prepend=sums[0])

    def increments(self, settings: OdometrySettings) -> Increments:
        """Return the odometry of the complete log, also outside the positions."""
        return integrate(self.wheels, settings, self.turn).increments

    def start(self, settings: OdometrySettings) -> State:
        """Estimate the pose at the first position, as an initial value."""
        made = self.increments(settings)
        return start_pose(made, self.fixes, self.lever_m)

    def reckon(self, start: State, car: Car, updated: int = 0) -> Predicted:
        """Dead reckoning with constant errors of the odometry as states of the filter.

        Args:
            start: State of the rear axle at the first position.
            car: The car, with its constants at the first position.
            updated: Number of positions, from the first on, that update the filter.
        """
        made, rows = car.constants, slice(0, 3)
        steps = self.steps(
            car.settings, car.delay_s, car.wander_m_per_sqrt_s, made.names, made.drift_var_per_s
        )
        pose = unpack_belief(0, start)
        cov = np.block([[pose.cov[rows, rows], made.cross[rows]], [made.cross[rows].T, made.cov]])
        cov_m2 = np.tile(car.fix_sd_m**2 * np.eye(2), (updated, 1, 1))
        return self.follow(np.append(pose.mean[rows], made.mean), cov, steps, cov_m2)

    def follow(self, mean: Floats, cov: Floats, steps: Steps, cov_m2: Floats) -> Predicted:
        """Run the filter along the steps.

        Args:
            mean: Shape (3 + K,): x, y and heading at the first position, and K parameters'
                deviations from the settings.
            cov: Shape (3 + K, 3 + K): their covariance.
            steps: Odometry from there on.
            cov_m2: Shape (L, 2, 2): covariances of the first L positions, which update the filter.
        """
        found = np.empty((len(self.fixes), 6))
        # Compiled, because a fit calls it hundreds of times.
        state = np.array(mean, np.float64), np.array(cov, np.float64)
        kept(_follow)(*state, steps, self.fixes.xy_m, cov_m2, self.lever_m, found)
        return _predicted(found)


def _predicted(found: Floats) -> Predicted:
    x, y, heading, xx, xy, yy = found.T
    spread = np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
    return Predicted(np.stack([x, y], axis=1), heading, spread)


def _follow(
    state: Floats,
    p: Floats,
    steps: Steps,
    fixes_m: Floats,
    cov_m2: Floats,
    lever_m: tuple[float, float],
    found: Floats,
) -> None:
    """Write the prediction of each position into ``found``; ``state`` and ``p`` change."""
    ahead_m, left_m = lever_m
    n, count = len(state), 0
    moved, by, seen = np.zeros((3, n - 2)), np.zeros((3, 2)), np.zeros((2, n))
    lost = np.zeros(2)
    for row in range(len(steps.at_fix)):
        effect = steps.by[row]
        distance_m, turn_rad = steps.distance_m[row], steps.turn_rad[row]
        for k in range(n - 3):
            distance_m += effect[0, k] * state[3 + k]
            turn_rad += effect[1, k] * state[3 + k]
        made, c, s = arc(distance_m, turn_rad), math.cos(state[2]), math.sin(state[2])
        by[0, 0] = c * made.dx_by_distance - s * made.dy_by_distance
        by[1, 0] = s * made.dx_by_distance + c * made.dy_by_distance
        by[0, 1] = c * made.dx_by_turn - s * made.dy_by_turn
        by[1, 1] = s * made.dx_by_turn + c * made.dy_by_turn
        by[2, 1] = 1.0
        moved[1, 0], moved[0, 0] = c * made.dx_m - s * made.dy_m, -s * made.dx_m - c * made.dy_m
        state[0], state[1] = state[0] + moved[1, 0], state[1] - moved[0, 0]
        state[2] += turn_rad
        for i in range(3):
            for k in range(n - 3):
                moved[i, 1 + k] = by[i, 0] * effect[0, k] + by[i, 1] * effect[1, k]
        # F P F', where F - I is ``moved``, in place: rows and columns of x and y before the
        # heading's, which they need as it was.
        for i in range(3):
            for k in range(n - 2):
                for j in range(n):
                    p[i, j] += moved[i, k] * p[2 + k, j]
        for i in range(3):
            for k in range(n - 2):
                for j in range(n):
                    p[j, i] += moved[i, k] * p[j, 2 + k]
        for i in range(3):
            for j in range(3):
                p[i, j] += by[i, 0] * by[j, 0] * steps.distance_var_m2[row]
                p[i, j] += by[i, 1] * by[j, 1] * steps.turn_var_rad2[row]
        for i in range(2):
            # The filter's position includes the error of the positions that wanders.
            p[i, i] += steps.wander_var_m2[row]
        # Of second order, as in ``predict_constants``; ``moved`` has the step as (-y, x).
        part = 1.0 - math.exp(-0.5 * p[2, 2])
        less = part * moved[1, 0], -part * moved[0, 0]
        for i in range(2):
            for j in range(2):
                p[i, j] += 3.0 * (less[i] * (lost[j] + less[j]) + lost[i] * less[j])
        lost[0] += less[0]
        lost[1] += less[1]
        for k in range(n - 3):
            p[3 + k, 3 + k] += steps.drift_var[row, k]
        k = steps.at_fix[row]
        if k < 0:
            continue
        c, s = math.cos(state[2]), math.sin(state[2])
        dx, dy = c * ahead_m - s * left_m, s * ahead_m + c * left_m
        seen[0], seen[1] = p[0] - dy * p[2], p[1] + dx * p[2]
        xx, xy = seen[0, 0] - dy * seen[0, 2], seen[0, 1] + dx * seen[0, 2]
        yy = seen[1, 1] + dx * seen[1, 2]
        line = found[count]
        line[0], line[1], line[2] = state[0] + dx, state[1] + dy, state[2]
        line[3], line[4], line[5] = xx, xy, yy
        count += 1
        if k >= len(cov_m2):
            continue
        x, y = fixes_m[k, 0] - line[0], fixes_m[k, 1] - line[1]
        # The weight of an outlier is reduced continuously at the gate.
        more = 1.0
        for _ in range(2):
            sxx, syy = xx + more * cov_m2[k, 0, 0], yy + more * cov_m2[k, 1, 1]
            sxy = xy + more * cov_m2[k, 0, 1]
            per = 1.0 / (sxx * syy - sxy * sxy)
            wx, wy = (syy * x - sxy * y) * per, (sxx * y - sxy * x) * per
            if more == 1.0:
                more = max((x * wx + y * wy) / GATE_NIS, 1.0)
        state += seen[0] * wx + seen[1] * wy
        lost[:] = 0.0
        for i in range(n):
            a = (seen[0, i] * syy - seen[1, i] * sxy) * per
            b = (seen[1, i] * sxx - seen[0, i] * sxy) * per
            for j in range(n):
                p[i, j] -= a * seen[0, j] + b * seen[1, j]


def whitened(predicted: Predicted, xy_m: Floats, cov_m2: Floats) -> tuple[Floats, Floats]:
    """Whiten the differences of positions from their predictions.

    Args:
        predicted: Predictions of N positions.
        xy_m: Shape (N, 2).
        cov_m2: Shape (N, 2, 2): covariances of the positions.

    Returns:
        Whitened differences, shape (N, 2), and log determinants of the covariances, shape (N,).
    """
    root = np.linalg.cholesky(predicted.cov_m2 + cov_m2)
    white: Floats = np.linalg.solve(root, (xy_m - predicted.xy_m)[:, :, None])[:, :, 0]
    log_det: Floats = 2.0 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    return white, log_det


def _covered(wheels: WheelSamples, turn: TurnSignal | None, fixes: Fixes) -> Fixes:
    """Positions while all signals are available, with a margin for the fitted delays."""
    spans = [wheels.t_ns] + ([] if turn is None else [turn.t_ns])
    if any(len(t_ns) < 2 for t_ns in spans):
        return fixes.take(slice(0, 0))
    margin_ns = round(MARGIN_S * 1e9)
    first = max(int(t[0]) for t in spans) + margin_ns
    last = min(int(t[-1]) for t in spans) - margin_ns
    return fixes.take((fixes.t_ns >= first) & (fixes.t_ns <= last))
