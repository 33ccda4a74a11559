"""A drive with known positions: odometry between them, and a filter with or without updates."""

from __future__ import annotations

import math
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.localization.constants import (
    NO_CONSTANTS,
    Constants,
    effects,
    predict_constants,
    update_constants,
)
from crosscue.localization.ekf import pack_belief, unpack_belief, update_point
from crosscue.localization.fixes import Fixes
from crosscue.localization.odometry import (
    Increments,
    OdometrySettings,
    TurnSignal,
    WheelSamples,
    integrate,
)
from crosscue.localization.pose_filter import State, at_point, predict_pose, update_position
from crosscue.localization.start_pose import start_pose
from crosscue.replay.compiled import kept

Floats: TypeAlias = NDArray[np.float64]
Int64s: TypeAlias = NDArray[np.int64]

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
    """

    at_fix: Int64s
    distance_m: Floats
    turn_rad: Floats
    distance_var_m2: Floats
    turn_var_rad2: Floats
    wander_var_m2: Floats


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
        drift_radps2: float = 0.0,
        delay_s: float = 0.0,
        wander_m_per_sqrt_s: float = 0.0,
    ) -> Steps:
        """Compute the odometry between the positions.

        Args:
            settings: Odometry settings of the car.
            drift_radps2: Drift of the gyro's bias, whose value in the settings is that in the
                middle of the drive.
            delay_s: Delay of the positions' timestamps.
            wander_m_per_sqrt_s: S.d. of the change of the positions' own error in one second.
        """
        turn = self.turn
        if turn is not None and drift_radps2:
            middle_s = (turn.t_ns - self.fixes.t_ns[0]) * 1e-9 - 0.5 * self.seconds[-1]
            turn = TurnSignal(turn.t_ns, turn.values - drift_radps2 * middle_s, turn.kind)
        made = integrate(self.wheels, settings, turn).increments
        columns = made.distance_m, made.turn_rad, made.distance_var_m2, made.turn_var_rad2
        summed = [self._between(made, column, delay_s) for column in columns]
        summed.append(wander_m_per_sqrt_s**2 * self.dt_s)
        return Steps(self.at_fix, *summed)

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
        steps = self.steps(car.settings, 0.0, car.delay_s, car.wander_m_per_sqrt_s)
        made, constants = self.increments(car.settings), car.constants
        by = effects(made, car.settings, constants.names)
        arcs = np.zeros((len(self.knots_s), *by.shape[1:]))
        for i, k in np.ndindex(by.shape[1:]):
            arcs[:, i, k] = self._between(made, by[:, i, k], car.delay_s)
        rows = zip(*(column.tolist() for column in steps), arcs, self.dt_s.tolist(), strict=True)
        state, found, cov_m2 = start, [], car.fix_sd_m**2 * np.eye(2)
        for at_fix, *step, wander_var, arc_by, dt_s in rows:
            state, constants = predict_constants(state, constants, (*step, 0.0), arc_by, dt_s)
            state = _wandered(state, wander_var)
            if at_fix < 0:
                continue
            seen = at_point(state, *self.lever_m)
            found.append(seen)
            if at_fix < updated:
                before = unpack_belief(0, state)
                after = update_point(before, self.fixes.xy_m[at_fix], cov_m2, self.lever_m).belief
                state, constants = pack_belief(after), update_constants(constants, before, after)
        return _predicted(np.array(found))

    def follow(self, start: State, steps: Steps, cov_m2: Floats | None = None) -> Predicted:
        """Run the filter along the steps.

        Args:
            start: State of the rear axle at the first position.
            steps: Odometry from there on.
            cov_m2: Shape (N, 2, 2): covariances of the positions for updates of the filter; None
                for dead reckoning.
        """
        found = np.empty((len(self.fixes), len(State._fields)))
        cov = np.empty((0, 2, 2)) if cov_m2 is None else cov_m2
        # Compiled, because a fit calls it hundreds of times.
        count = kept(_follow)(start, steps, self.fixes.xy_m, cov, self.lever_m, found)
        return _predicted(found[:count])


def _predicted(states: Floats) -> Predicted:
    x, y, heading, _, xx, xy, _, _, yy = states.T[:9]
    spread = np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
    return Predicted(np.stack([x, y], axis=1), heading, spread)


def _follow(
    state: State,
    steps: Steps,
    fixes_m: Floats,
    cov_m2: Floats,
    lever_m: tuple[float, float],
    found: Floats,
) -> int:
    """Write the state at each position into ``found``; return their number."""
    at_fix, distance_m, turn_rad, distance_var_m2, turn_var_rad2, wander_var_m2 = steps
    ahead_m, left_m = lever_m
    count = 0
    for row in range(len(at_fix)):
        state = predict_pose(
            state, distance_m[row], turn_rad[row], distance_var_m2[row], turn_var_rad2[row], 0.0
        )
        state = _wandered(state, wander_var_m2[row])
        k = at_fix[row]
        if k < 0:
            continue
        seen = at_point(state, ahead_m, left_m)
        for column in range(len(seen)):
            found[count, column] = seen[column]
        count += 1
        if len(cov_m2):
            x, y = fixes_m[k, 0], fixes_m[k, 1]
            weighed = _weighed(seen, x, y, cov_m2[k, 0, 0], cov_m2[k, 0, 1], cov_m2[k, 1, 1])
            state = at_point(weighed, -ahead_m, -left_m)
    return count


def _wandered(state: State, var_m2: float) -> State:
    """Let the positions' own error wander; the filter's position includes it."""
    x, y, heading, speed, xx, xy, xh, xv, yy, yh, yv, hh, hv, vv = state
    return State(x, y, heading, speed, xx + var_m2, xy, xh, xv, yy + var_m2, yh, yv, hh, hv, vv)


def _weighed(seen: State, x: float, y: float, var_x: float, cov_xy: float, var_y: float) -> State:
    """Update with one position; the weight of an outlier is reduced continuously at the gate."""
    nis = update_position(seen, x, y, var_x, cov_xy, var_y, 0.0).nis
    more = max(nis / GATE_NIS, 1.0)
    return update_position(seen, x, y, more * var_x, more * cov_xy, more * var_y, math.inf).state


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
