"""Constant errors of a car's odometry as states of the pose filter, such as a gyro's bias.

An error of a scale or of a bias is the same along a whole drive, so it is no process noise: its
effect grows with distance or time, and turns can undo it. The states are the parameters' deviations
from the settings, and the pose filter is augmented by them (Bar-Shalom, Li, Kirubarajan,
*Estimation with Applications to Tracking and Navigation*, section 11.9). The motion's Jacobian
propagates them; measurements of the pose update them by their correlation with it. A parameter may
drift as a random walk. Without constants, the filter is the published one.

With them, the covariance is of second order in the heading: a car whose heading is uncertain comes
less far than the arc says. These errors of all steps since a measurement have one sign, so that
their sum is kept, and not the sum of their squares.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, TypeAlias

import numpy as np

from crosscue.replay.columns import Floats

from .angles import wrap
from .ekf import PoseBelief, coasting, odometry_derivatives
from .odometry import BY_STEERING, BY_WHEELS, BY_YAW_RATE, Increments, OdometrySettings, TurnKind
from .pose_filter import HEADING, State, predict_pose

# Parameters of each source of turns.
TURN_PARAMETERS: Final[Mapping[str, tuple[str, ...]]] = {
    "yaw rate": ("gyro_bias_radps", "yaw_rate_scale"),
    "steering": ("steering_ratio", "steering_offset_rad", "understeer_s2pm2", "wheelbase_m"),
    "wheels": ("right_wheel_scale", "track_width_m"),
}
# Parameters of each source whose errors drift: tyres slip more uphill than downhill, and the road's
# bank, the load and the temperature change what is straight.
DRIFTING: Final[Mapping[str, tuple[str, str]]] = {
    "yaw rate": ("wheel_scale", "gyro_bias_radps"),
    "steering": ("wheel_scale", "steering_offset_rad"),
    "wheels": ("wheel_scale", "right_wheel_scale"),
}
_UPPER: Final = np.triu_indices(4)
# Correlation of pose states below which they count as linearly dependent.
_RANK: Final = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Constants:
    """Gaussian over K parameters' deviations from the settings, and its covariance with the pose.

    Attributes:
        names: K names of parameters: keys of ``EFFECTS``.
        mean: Shape (K,): parameter minus its value in the settings.
        cov: Shape (K, K).
        cross: Shape (4, K): covariance of the pose's states and the parameters.
        drift_var_per_s: Shape (K,): growth of each parameter's variance per second.
        lost_m: Shape (2,): expected way lost by the heading's uncertainty since a measurement.
    """

    names: tuple[str, ...]
    mean: Floats
    cov: Floats
    cross: Floats
    drift_var_per_s: Floats
    lost_m: Floats = field(default_factory=lambda: np.zeros(2))


NO_CONSTANTS: Final = Constants((), np.empty(0), np.empty((0, 0)), np.empty((4, 0)), np.empty(0))


def start_constants(
    names: tuple[str, ...],
    cov: Floats,
    drift_per_sqrt_s: Mapping[Any, float],
    turn: TurnKind | None,
) -> Constants | None:
    """Build constants that are independent of the pose; None if no parameter in use varies.

    Args:
        names: K names of parameters.
        cov: Shape (K, K): their covariance.
        drift_per_sqrt_s: Standard deviation of a parameter's change in one second, by name.
        turn: Signal for the turns; None for the wheels' difference. Parameters of the other signal
            are left out; those of the wheels are not, because the wheels replace a missing signal.
    """
    unused = {
        name
        for kind, of_kind in TURN_PARAMETERS.items()
        if kind not in (turn, "wheels")
        for name in of_kind
    }
    drift = np.array([drift_per_sqrt_s.get(name, 0.0) ** 2 for name in names])
    varies = np.diagonal(cov) + drift > 0.0
    rows = [i for i, name in enumerate(names) if varies[i] and name not in unused]
    if not rows:
        return None
    kept, k = tuple(names[i] for i in rows), len(rows)
    return Constants(kept, np.zeros(k), cov[np.ix_(rows, rows)], np.zeros((4, k)), drift[rows])


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """Columns of N increments, for the derivatives."""

    distance_m: Floats
    turn_rad: Floats
    dt_s: Floats
    speed_mps: Floats
    by: Mapping[int, Floats]
    car: OdometrySettings

    def curvature(self) -> Floats:
        """Turn per distance; 0 for a car that stands."""
        zero = np.zeros_like(self.turn_rad)
        return np.divide(self.turn_rad, self.distance_m, zero, where=self.distance_m != 0.0)

    def understeer(self) -> Floats:
        """Factor by which the wheelbase is in effect longer at speed."""
        return 1.0 + self.car.understeer_s2pm2 * (self.distance_m / self.dt_s) ** 2

    def base_m(self) -> Floats:
        """Wheelbase of a car without understeer that turns as this one."""
        return (self.car.wheelbase_m or 1.0) * self.understeer()

    def tangent(self) -> Floats:
        """Tangent of the road-wheel angle."""
        return self.base_m() * self.curvature()

    def turn_by_angle(self) -> Floats:
        """Derivative of a turn by steering with respect to the road-wheel angle."""
        return self.by[BY_STEERING] * self.distance_m * (1.0 + self.tangent() ** 2) / self.base_m()

    def by_understeer(self) -> Floats:
        """Derivative of a turn by steering with respect to the understeer."""
        speed2 = (self.distance_m / self.dt_s) ** 2
        return -self.by[BY_STEERING] * self.turn_rad * speed2 / self.understeer()

    def by_wheel_scale(self) -> tuple[Floats, Floats]:
        """Derivatives of distance and turn by the scale of all wheels."""
        by_speed = 2.0 * self.by[BY_STEERING] * (1.0 - 1.0 / self.understeer())
        per_turn = 1.0 - self.by[BY_YAW_RATE] - by_speed
        scale = self.car.wheel_scale
        return self.distance_m / scale, per_turn * self.turn_rad / scale

    def by_delay(self) -> tuple[Floats, Floats]:
        """Derivatives by the wheels' delay: the change of speed, and none of the turn.

        Between two times, a delay adds its product with the change of the yaw rate to the turn,
        which is zero again after each bend.
        """
        change_mps = 2.0 * (self.speed_mps - self.distance_m / self.dt_s)
        return change_mps, np.zeros_like(change_mps)

    def by_right(self) -> tuple[Floats, Floats]:
        """Derivatives of distance and turn by the right wheels' scale."""
        right_m = self.distance_m + 0.5 * self.car.track_width_m * self.turn_rad
        per_scale = right_m / self.car.right_wheel_scale
        by_wheels = self.by[BY_WHEELS] / self.car.track_width_m
        by_steering = self.by[BY_STEERING] * 0.5 * self.curvature()
        return 0.5 * per_scale, (by_wheels + by_steering) * per_scale


_Columns: TypeAlias = Callable[[_Motion], tuple[Floats, Floats] | Floats]
# Derivatives of distance and turn by each parameter; of the turn only, if there is one column.
EFFECTS: Final[Mapping[str, _Columns]] = {
    "wheel_scale": _Motion.by_wheel_scale,
    "gyro_bias_radps": lambda m: -m.by[BY_YAW_RATE] * m.car.yaw_rate_scale * m.dt_s,
    "yaw_rate_scale": lambda m: m.by[BY_YAW_RATE] * m.turn_rad / m.car.yaw_rate_scale,
    "steering_ratio": lambda m: -m.turn_by_angle() * np.arctan(m.tangent()) / m.car.steering_ratio,
    "steering_offset_rad": lambda m: -m.turn_by_angle() / m.car.steering_ratio,
    "understeer_s2pm2": _Motion.by_understeer,
    "wheelbase_m": lambda m: -m.by[BY_STEERING] * m.turn_rad / (m.car.wheelbase_m or 1.0),
    "right_wheel_scale": _Motion.by_right,
    "wheel_delay_s": _Motion.by_delay,
    "track_width_m": lambda m: -m.by[BY_WHEELS] * m.turn_rad / m.car.track_width_m,
}


def effects(made: Increments, settings: OdometrySettings, names: tuple[str, ...]) -> Floats:
    """Derivatives of each increment's distance and turn by the parameters, shape (N, 2, K)."""
    by = {
        source: np.asarray(made.turn_source == source, np.float64)
        for source in (BY_YAW_RATE, BY_STEERING, BY_WHEELS)
    }
    dt_s = np.asarray((made.stop_ns - made.start_ns) * 1e-9)
    motion = _Motion(made.distance_m, made.turn_rad, dt_s, made.speed_mps, by, settings)
    found = np.zeros((len(made), 2, len(names)))
    for k, name in enumerate(names):
        columns = EFFECTS[name](motion)
        found[:, 0, k], found[:, 1, k] = columns if isinstance(columns, tuple) else (0.0, columns)
    return found


def predict_constants(
    state: State, constants: Constants, step: tuple[float, ...], by: Floats, dt_s: float
) -> tuple[State, Constants]:
    """Predict the pose and its covariance with the parameters along one arc of odometry.

    Args:
        state: State before the interval.
        constants: Parameters before the interval.
        step: Arguments of ``predict_pose`` after the state, by the settings.
        by: Shape (2, K): derivatives of distance and turn by the parameters.
        dt_s: Length of the interval.
    """
    off_m, off_rad = (by @ constants.mean).tolist()
    distance_m, turn_rad, *noise = step
    by_state, by_input = odometry_derivatives(
        state.heading_rad, distance_m + off_m, turn_rad + off_rad, by
    )
    moved = by_state @ constants.cross
    caused = by_input @ constants.cov
    shared = moved @ by_input.T
    added = shared + shared.T + caused @ by_input.T
    after = predict_pose(state, distance_m + off_m, turn_rad + off_rad, *noise)
    hh = after.hh + float(added[HEADING, HEADING])
    before_m = constants.lost_m
    lost_m = before_m - np.expm1(-0.5 * hh) * np.subtract(after[:2], state[:2])
    # The mean square of a squared Gaussian is three times the square of its mean.
    added[:2, :2] += 3.0 * (np.outer(lost_m, lost_m) - np.outer(before_m, before_m))
    cov = np.array(after[4:]) + added[_UPPER]
    moved_on = replace(_drifted(constants, moved + caused, dt_s), lost_m=lost_m)
    return State(*after[:4], *cov.tolist()), moved_on


def coast_constants(belief: PoseBelief, constants: Constants, dt_s: float) -> Constants:
    """Predict the parameters while the car coasts from ``belief``."""
    _, by_state = coasting(belief.mean, dt_s)
    return _drifted(constants, by_state @ constants.cross, dt_s)


def _drifted(constants: Constants, cross: Floats, dt_s: float) -> Constants:
    cov = constants.cov + np.diag(dt_s * constants.drift_var_per_s)
    return replace(constants, cov=cov, cross=cross)


def update_constants(constants: Constants, before: PoseBelief, after: PoseBelief) -> Constants:
    """Update the parameters after any measurement of the pose.

    The measurement tells of the parameters only what it tells of the pose, so their posterior is
    their regression on the pose, as in a smoother (Bar-Shalom et al., section 8.6).

    Args:
        constants: Parameters before the measurement.
        before: Pose before the measurement.
        after: Pose after it.
    """
    sd = np.sqrt(np.diagonal(before.cov))
    sd = np.where(sd > 0.0, sd, 1.0)
    inverse = np.linalg.pinv(before.cov / np.outer(sd, sd), rcond=_RANK, hermitian=True)
    gain = (constants.cross / sd[:, None]).T @ inverse / sd
    moved = after.mean - before.mean
    moved[HEADING] = wrap(moved[HEADING])
    return replace(
        constants,
        mean=constants.mean + gain @ moved,
        cov=constants.cov + gain @ (after.cov - before.cov) @ gain.T,
        cross=after.cov @ gain.T,
        lost_m=np.zeros(2),
    )
