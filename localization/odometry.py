"""Distance and change of heading between wheel-speed samples, with variances.

Dead reckoning for the centre of the rear axle. The change of heading comes from the best available
source: a yaw rate, otherwise the steering angle, otherwise the difference between left and right
wheels. The noise parameters do not depend on the sampling rate: errors grow with the root of
distance or time, apart from the wheel sensors' rounding. A constant error of wheel scale, track
width or gyro bias is not noise; fit it first.

Long drives are processed in windows. Cut every column at one common time and pass that time as
``until_ns``. Rows whose interval cannot be completed yet wait in ``Pending``, and the increments
are identical, bit for bit, to those of a single window.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Final, Literal, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import ColumnSet, Floats, Int64s

Bools: TypeAlias = NDArray[np.bool_]
TurnKind: TypeAlias = Literal["yaw rate", "steering"]

BY_YAW_RATE: Final = 0
BY_STEERING: Final = 1
BY_WHEELS: Final = 2
# Turn source of a gap between two time segments, without odometry.
BY_NOTHING: Final = 3


@dataclass(frozen=True, slots=True)
class OdometrySettings:
    """Geometry, corrections and noise of one car's odometry.

    Attributes:
        track_width_m: Distance between left and right wheels.
        wheelbase_m: Distance between the axles; needed for steering and for the front wheels.
        wheel_scale: True speed per reported speed.
        right_wheel_scale: Additional scale of the right-hand wheels. A tyre that is 0.1 % larger
            than the other turns the wheels' heading by half a radian per kilometre.
        front_left_scale: Additional scale of the front left wheel; None for that of the rear wheel
            on its side.
        front_right_scale: Additional scale of the front right wheel; None for that of the rear
            wheel on its side.
        use_front_wheels: True to average all four wheels, where available; else the rear two.
        wheel_step_mps: Resolution of the reported wheel speed; errors are up to half of it.
        slip_per_sqrt_m: S.d. of the distance after one metre.
        yaw_rate_scale: True yaw rate per reported yaw rate.
        gyro_bias_radps: Reported yaw rate at rest, subtracted before scaling.
        gyro_noise_rad_per_sqrt_s: S.d. of the heading after one second.
        steering_ratio: Steering-wheel angle per road-wheel angle; 1 for road-wheel angles.
        steering_offset_rad: Reported angle when driving straight, before the ratio.
        understeer_s2pm2: Growth of the angle for the same turn with the square of the speed: the
            inverse square of the car's characteristic speed.
        steering_noise_rad_sqrt_m: Noise density of the road-wheel angle over distance: its s.d.
            times the root of the distance over which its error persists.
        wheel_turn_rad_per_sqrt_m: S.d. of the heading by wheel difference after one metre.
        turn_per_turn: S.d. of the change of heading as a fraction of that change.
        turn_rad_per_sqrt_rad: S.d. of the heading after one radian of turning.
        wheel_delay_s: Delay of the timestamps of wheel speeds and turn signal.
        turn_delay_s: Delay of the turn signal's timestamps relative to those of the wheel speeds.
        max_gap_s: Distance of samples above which there is a gap: it is counted, and the variances
            grow.
        gap_accel_mps2: Assumed s.d. of acceleration inside a gap.
        gap_yaw_accel_radps2: Assumed s.d. of yaw acceleration inside a gap.
    """

    track_width_m: float
    wheelbase_m: float | None = None
    wheel_scale: float = 1.0
    right_wheel_scale: float = 1.0
    front_left_scale: float | None = None
    front_right_scale: float | None = None
    use_front_wheels: bool = False
    wheel_step_mps: float = 0.0
    slip_per_sqrt_m: float = 0.02
    yaw_rate_scale: float = 1.0
    gyro_bias_radps: float = 0.0
    gyro_noise_rad_per_sqrt_s: float = 1e-3
    steering_ratio: float = 1.0
    steering_offset_rad: float = 0.0
    understeer_s2pm2: float = 0.0
    steering_noise_rad_sqrt_m: float = 0.01
    wheel_turn_rad_per_sqrt_m: float = 0.01
    turn_per_turn: float = 0.0
    turn_rad_per_sqrt_rad: float = 0.0
    wheel_delay_s: float = 0.0
    turn_delay_s: float = 0.0
    max_gap_s: float = 0.5
    gap_accel_mps2: float = 3.0
    gap_yaw_accel_radps2: float = 0.5

    @property
    def wheel_scales(self) -> Floats:
        """Scales of front left, front right, rear left and rear right wheel, shape (4,)."""
        rear = (1.0, self.right_wheel_scale)
        front = (self.front_left_scale, self.front_right_scale)
        of_front = [own or side for own, side in zip(front, rear, strict=True)]
        return self.wheel_scale * np.array([*of_front, *rear])


@dataclass(frozen=True, slots=True, eq=False)
class WheelSamples(ColumnSet):
    """N samples of two rear or of all four wheels.

    Attributes:
        t_ns: Shape (N,), int64.
        wheels_mps: Shape (N, 2) rear left, rear right; or (N, 4) front left, front right, rear
            left, rear right. Signed if the sensor measures the direction.
    """

    t_ns: Int64s
    wheels_mps: Floats


@dataclass(frozen=True, slots=True, eq=False)
class TurnSignal:
    """N samples of yaw rate or steering angle.

    Attributes:
        t_ns: Shape (N,), int64.
        values: Shape (N,): yaw rate in rad/s, or steering angle in rad; positive to the left.
        kind: Kind of the values.
    """

    t_ns: Int64s
    values: Floats
    kind: TurnKind

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass(frozen=True, slots=True)
class OdometryCounts:
    """Account of the rows; counts of several windows can be added.

    Attributes:
        rows: Number of wheel rows.
        not_finite: Wheel rows dropped because a wheel in use is NaN or infinite.
        repeated: Wheel rows dropped because they have the time of the previous row.
        out_of_order: Wheel rows dropped because they are earlier than a previous row.
        turn_rows: Number of yaw-rate or steering rows.
        turn_dropped: Turn rows dropped for any of these three reasons.
        intervals: Number of increments.
        gaps: Number of increments longer than ``max_gap_s``.
        turn_missing: Number of increments with a gap in the turn signal, whose heading comes from
            the wheels.
    """

    rows: int = 0
    not_finite: int = 0
    repeated: int = 0
    out_of_order: int = 0
    turn_rows: int = 0
    turn_dropped: int = 0
    intervals: int = 0
    gaps: int = 0
    turn_missing: int = 0

    def __add__(self, other: Self) -> Self:
        names = [f.name for f in fields(self)]
        return type(self)(**{name: getattr(self, name) + getattr(other, name) for name in names})


@dataclass(frozen=True, slots=True, eq=False)
class Increments(ColumnSet):
    """N intervals between consecutive wheel samples.

    Attributes:
        start_ns: Shape (N,), int64.
        stop_ns: Shape (N,), int64.
        distance_m: Shape (N,): distance of the rear axle, negative in reverse.
        turn_rad: Shape (N,): change of heading, positive to the left.
        distance_var_m2: Shape (N,).
        turn_var_rad2: Shape (N,).
        speed_mps: Shape (N,): speed of the rear axle at the end.
        speed_var_m2ps2: Shape (N,).
        turn_source: Shape (N,), uint8: ``BY_YAW_RATE``, ``BY_STEERING``, ``BY_WHEELS``; or
            ``BY_NOTHING`` for an assumed increment in a gap.
        is_gap: Shape (N,), bool: True if longer than ``max_gap_s``.
    """

    start_ns: Int64s
    stop_ns: Int64s
    distance_m: Floats
    turn_rad: Floats
    distance_var_m2: Floats
    turn_var_rad2: Floats
    speed_mps: Floats
    speed_var_m2ps2: Floats
    turn_source: NDArray[np.uint8]
    is_gap: Bools


@dataclass(frozen=True, slots=True, eq=False)
class Pending:
    """Rows that wait for the next window; the first window starts with ``Pending()``.

    Attributes:
        t_ns: Shape (N,): times of wheel rows, starting with the last used one.
        axle_mps: Shape (N,): speed of the rear axle.
        yaw_radps: Shape (N,): yaw rate by wheel difference.
        turn_t_ns: Shape (M,): times of turn rows, starting with the last used one.
        turn_values: Shape (M,).
    """

    t_ns: Int64s = field(default_factory=lambda: np.empty(0, np.int64))
    axle_mps: Floats = field(default_factory=lambda: np.empty(0))
    yaw_radps: Floats = field(default_factory=lambda: np.empty(0))
    turn_t_ns: Int64s = field(default_factory=lambda: np.empty(0, np.int64))
    turn_values: Floats = field(default_factory=lambda: np.empty(0))


class OdometryWindow(NamedTuple):
    """Result of one window."""

    increments: Increments
    pending: Pending
    counts: OdometryCounts


class _Clean(NamedTuple):
    keep: Bools
    not_finite: int
    repeated: int
    out_of_order: int


def integrate(
    wheels: WheelSamples,
    settings: OdometrySettings,
    turn: TurnSignal | None = None,
    pending: Pending | None = None,
    until_ns: int | None = None,
) -> OdometryWindow:
    """Compute distance and change of heading from each wheel row to the next.

    Args:
        wheels: The window's wheel rows, in stored order.
        settings: Geometry, corrections and noise of the car.
        turn: The window's yaw rate or steering; None if the car has neither. The choice must be the
            same in every window.
        pending: Pending rows of the previous window.
        until_ns: Time before which all rows are complete; None for the last window.

    Raises:
        ValueError: The settings lack a length that the chosen source needs.
    """
    pending = pending or Pending()
    _check_geometry(settings, turn)
    axle_mps, yaw_radps = _at_rear_axle(wheels, settings)
    wheel_delay_ns = round(settings.wheel_delay_s * 1e9)
    until_ns = None if until_ns is None else until_ns - wheel_delay_ns
    wheels_ns = wheels.t_ns - wheel_delay_ns
    clean = _clean(wheels_ns, axle_mps, pending.t_ns)
    t_ns = np.concatenate([pending.t_ns, wheels_ns[clean.keep]])
    axle_mps = np.concatenate([pending.axle_mps, axle_mps[clean.keep]])
    yaw_radps = np.concatenate([pending.yaw_radps, yaw_radps[clean.keep]])
    delay_ns = round(settings.turn_delay_s * 1e9)
    joined, turn_dropped = _join_turn(turn, pending, delay_ns + wheel_delay_ns)

    ready = len(t_ns)
    if joined is not None and until_ns is not None:
        # Turn rows are complete up to this time, on the wheels' clock.
        turn_until_ns = until_ns - max(delay_ns, 0)
        ready = _ready(t_ns, joined.t_ns, round(settings.max_gap_s * 1e9), turn_until_ns)
    made = _increments(t_ns[:ready], axle_mps[:ready], yaw_radps[:ready], joined, settings)
    counts = OdometryCounts(
        rows=len(wheels),
        not_finite=clean.not_finite,
        repeated=clean.repeated,
        out_of_order=clean.out_of_order,
        turn_rows=0 if turn is None else len(turn),
        turn_dropped=turn_dropped,
        intervals=len(made),
        gaps=int(made.is_gap.sum()),
        turn_missing=0 if joined is None else int((made.turn_source != joined.source).sum()),
    )
    last = max(ready - 1, 0)
    rest = Pending(t_ns[last:], axle_mps[last:], yaw_radps[last:])
    return OdometryWindow(
        made, rest if joined is None else _keep_turn(rest, joined, until_ns), counts
    )


def first_reading(wheels: WheelSamples, settings: OdometrySettings) -> tuple[int, float] | None:
    """Time and rear-axle speed in m/s of the first finite row; None without one."""
    axle_mps, _ = _at_rear_axle(wheels, settings)
    rows = np.flatnonzero(np.isfinite(axle_mps))
    t_ns = wheels.t_ns - round(settings.wheel_delay_s * 1e9)
    return (int(t_ns[rows[0]]), float(axle_mps[rows[0]])) if len(rows) else None


def _check_geometry(settings: OdometrySettings, turn: TurnSignal | None) -> None:
    needs_base = settings.use_front_wheels or (turn is not None and turn.kind == "steering")
    if needs_base and settings.wheelbase_m is None:
        raise ValueError("wheelbase_m: needed for steering and for front wheels, got None")


def _at_rear_axle(wheels: WheelSamples, settings: OdometrySettings) -> tuple[Floats, Floats]:
    """Speed of the rear axle's centre, and yaw rate by the difference of left and right wheels."""
    speeds = wheels.wheels_mps * settings.wheel_scales[-wheels.wheels_mps.shape[1] :]
    left, right = speeds[:, -2], speeds[:, -1]
    if settings.use_front_wheels and speeds.shape[1] == 4 and settings.wheelbase_m is not None:
        front_sideways_mps = (right - left) / settings.track_width_m * settings.wheelbase_m
        left = 0.5 * (left + _along_body(speeds[:, 0], front_sideways_mps))
        right = 0.5 * (right + _along_body(speeds[:, 1], front_sideways_mps))
    return 0.5 * (left + right), (right - left) / settings.track_width_m


def _along_body(front_mps: Floats, sideways_mps: Floats) -> Floats:
    """Component of a steered wheel's speed along the car's axis."""
    return np.sign(front_mps) * np.sqrt(np.maximum(front_mps**2 - sideways_mps**2, 0.0))


def _clean(t_ns: Int64s, values: Floats, before_ns: Int64s) -> _Clean:
    """Select rows that are finite and later than every row kept before them."""
    finite = np.isfinite(values)
    floor = before_ns[-1] if len(before_ns) else np.iinfo(np.int64).min
    times = np.where(finite, t_ns, floor)
    latest = np.maximum.accumulate(np.concatenate([[floor], times]))[:-1]
    later = t_ns > latest
    keep = finite & later
    repeated = finite & (t_ns == latest)
    n_repeated = int(repeated.sum())
    return _Clean(keep, int((~finite).sum()), n_repeated, int((finite & ~later).sum()) - n_repeated)


def _join_turn(
    turn: TurnSignal | None, pending: Pending, delay_ns: int
) -> tuple[_Turn | None, int]:
    """Join pending rows and new ones; the new ones are shifted to the wheels' clock."""
    if turn is None:
        return None, 0
    moved_ns = turn.t_ns - delay_ns
    keep = _clean(moved_ns, turn.values, pending.turn_t_ns).keep
    t_ns = np.concatenate([pending.turn_t_ns, moved_ns[keep]])
    values = np.concatenate([pending.turn_values, turn.values[keep]])
    return _Turn(t_ns, values, turn.kind), int((~keep).sum())


def _keep_turn(rest: Pending, turn: _Turn, until_ns: int | None) -> Pending:
    """Keep the turn rows that are still needed for pending or future wheel rows."""
    next_ns = rest.t_ns[0] if len(rest.t_ns) else until_ns
    used = len(turn.t_ns)
    if next_ns is not None:
        used = int(np.searchsorted(turn.t_ns, next_ns, side="right"))
    first = max(used - 1, 0)
    return replace(rest, turn_t_ns=turn.t_ns[first:], turn_values=turn.values[first:])


def _ready(t_ns: Int64s, turn_t_ns: Int64s, max_gap_ns: int, until_ns: int) -> int:
    """Number of wheel rows that are complete: up to the turn signal or, in gaps, ``until_ns``."""
    if len(turn_t_ns) == 0 or until_ns - turn_t_ns[-1] > max_gap_ns:
        return int(np.searchsorted(t_ns, until_ns))
    return int(np.searchsorted(t_ns, turn_t_ns[-1], side="right"))


def _increments(
    t_ns: Int64s,
    axle_mps: Floats,
    yaw_radps: Floats,
    turn: _Turn | None,
    settings: OdometrySettings,
) -> Increments:
    dt_s = np.diff(t_ns) * 1e-9
    is_gap = np.diff(t_ns) > round(settings.max_gap_s * 1e9)
    distance_m = _trapezoid(axle_mps, dt_s)
    by_slip = settings.slip_per_sqrt_m**2 * np.abs(distance_m)
    # Neighbouring intervals share a sample, so each includes the rounding of a whole sample.
    by_step = 0.5 * settings.wheel_step_mps**2 / 12.0
    unseen_s2 = np.where(is_gap, 0.25 * dt_s**2, 0.0)
    turn_rad, turn_var = _turn_by_wheels(yaw_radps, dt_s, distance_m, unseen_s2, settings)
    source = np.full(len(dt_s), BY_WHEELS, np.uint8)
    if turn is not None:
        made_rad, made_var = turn.over(t_ns, distance_m, settings)
        covered = turn.covers(t_ns, settings)
        turn_rad = np.where(covered, made_rad, turn_rad)
        turn_var = np.where(covered, made_var, turn_var)
        source[covered] = turn.source
    return Increments(
        start_ns=t_ns[:-1],
        stop_ns=t_ns[1:],
        distance_m=distance_m,
        turn_rad=turn_rad,
        distance_var_m2=by_slip + by_step * dt_s**2 + (settings.gap_accel_mps2 * unseen_s2) ** 2,
        turn_var_rad2=turn_var
        + (settings.turn_per_turn * turn_rad) ** 2
        + settings.turn_rad_per_sqrt_rad**2 * np.abs(turn_rad),
        speed_mps=axle_mps[1:],
        speed_var_m2ps2=by_step + by_slip / dt_s**2,
        turn_source=source,
        is_gap=is_gap,
    )


def _trapezoid(rate: Floats, dt_s: Floats) -> Floats:
    return 0.5 * (rate[:-1] + rate[1:]) * dt_s


def _turn_by_wheels(
    yaw_radps: Floats,
    dt_s: Floats,
    distance_m: Floats,
    unseen_s2: Floats,
    settings: OdometrySettings,
) -> tuple[Floats, Floats]:
    by_step = 2.0 * settings.wheel_step_mps**2 / 12.0 / settings.track_width_m**2
    variance = (
        settings.wheel_turn_rad_per_sqrt_m**2 * np.abs(distance_m)
        + by_step * dt_s**2
        + (settings.gap_yaw_accel_radps2 * unseen_s2) ** 2
    )
    return _trapezoid(yaw_radps, dt_s), variance


@dataclass(frozen=True, slots=True, eq=False)
class _Turn:
    """A turn signal over the whole window, including rows of the previous window."""

    t_ns: Int64s
    values: Floats
    kind: TurnKind

    @property
    def source(self) -> int:
        return BY_YAW_RATE if self.kind == "yaw rate" else BY_STEERING

    def covers(self, t_ns: Int64s, settings: OdometrySettings) -> Bools:
        """Mark the intervals between wheel rows in which the signal has no gap."""
        if len(self.t_ns) == 0:
            return np.zeros(max(len(t_ns) - 1, 0), np.bool_)
        is_gap = np.diff(self.t_ns) > round(settings.max_gap_s * 1e9)
        gaps_before = np.concatenate([[0], np.cumsum(is_gap)])
        last = len(self.t_ns) - 1
        first_row = np.searchsorted(self.t_ns, t_ns[:-1], side="right") - 1
        last_row = np.searchsorted(self.t_ns, t_ns[1:], side="left")
        is_inside = (first_row >= 0) & (last_row <= last)
        gaps = gaps_before[np.minimum(last_row, last)] - gaps_before[np.maximum(first_row, 0)]
        is_whole: Bools = gaps == 0
        return is_inside & is_whole

    def over(
        self, t_ns: Int64s, distance_m: Floats, settings: OdometrySettings
    ) -> tuple[Floats, Floats]:
        """Change of heading from row to row, and its variance; undefined where not covered."""
        dt_s = np.diff(t_ns) * 1e-9
        area = self._integral(t_ns)
        if self.kind == "yaw rate":
            turn_rad = settings.yaw_rate_scale * (area - settings.gyro_bias_radps * dt_s)
            return turn_rad, settings.gyro_noise_rad_per_sqrt_s**2 * dt_s
        assert settings.wheelbase_m is not None
        angle_rad = (area / dt_s - settings.steering_offset_rad) / settings.steering_ratio
        # Tyres slip sideways, so that a turn at speed needs a larger angle.
        base_m = settings.wheelbase_m * (1.0 + settings.understeer_s2pm2 * (distance_m / dt_s) ** 2)
        curvature = np.tan(angle_rad) / base_m
        by_angle = (1.0 + np.tan(angle_rad) ** 2) / base_m
        variance = (settings.steering_noise_rad_sqrt_m * by_angle) ** 2 * np.abs(distance_m)
        return distance_m * curvature, variance

    def _integral(self, t_ns: Int64s) -> Floats:
        """Integral of the signal, linear between its samples, from wheel row to wheel row."""
        n = max(len(t_ns) - 1, 0)
        if n == 0 or len(self.t_ns) == 0:
            return np.zeros(n)
        inside = self.t_ns[(self.t_ns > t_ns[0]) & (self.t_ns < t_ns[-1])]
        knots = np.union1d(t_ns, inside)
        pieces = _trapezoid(self._at(knots), np.diff(knots) * 1e-9)
        interval = np.searchsorted(t_ns, knots[:-1], side="right") - 1
        return np.bincount(interval, weights=pieces, minlength=n).astype(np.float64)

    def _at(self, at_ns: Int64s) -> Floats:
        before = np.clip(np.searchsorted(self.t_ns, at_ns, side="right") - 1, 0, None)
        after = np.minimum(before + 1, len(self.t_ns) - 1)
        span_ns = np.maximum(self.t_ns[after] - self.t_ns[before], 1)
        fraction: Floats = (at_ns - self.t_ns[before]) / span_ns
        rise: Floats = self.values[after] - self.values[before]
        return self.values[before] + fraction * rise
