"""Fit a car's odometry to a drive with known positions, and say what the drive could show.

Maximum likelihood by prediction errors (L. Ljung, *System Identification*, 2nd ed., section 7.4):
the pose filter runs along the drive under trial parameters, and what each position differs from
the filter's prediction, in units of its own covariance, is a residual of ``least_squares`` with a
robust loss. Unlike dead reckoning against positions, this keeps residuals independent, because
what odometry had accumulated is taken off at each position. The noise densities are those under
which the residuals are most likely; fitting and noise take turns.

The inverse of the information matrix states each parameter's variance. Parameters are measured in
what would be plausible for a car: one that the drive determines to no better than a fraction of
that keeps its given value and is named, the worst first, and the rest is fitted without it. So one
of two that only show together (steering ratio and wheelbase) stays as given.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from crosscue.replay.base import Floats, Int64s, VehicleError

from .angles import wrap
from .compass_fit import NotObservable, persistence
from .fixes import Fixes
from .odometry import OdometrySettings, TurnSignal, WheelSpeeds, integrate
from .pose_filter import State, at_point, predict, update_position
from .start_pose import start_pose

STEP_S: Final = 0.2
"""Odometry is followed in arcs no longer than this."""
GATE_NIS: Final = 13.8
"""One good position in a thousand is further off; beyond, it counts for less and less."""
LOSS_SD: Final = 2.0
"""Where the robust loss turns from squares to absolute values."""
DETERMINED: Final = 0.3
"""Largest s.d., as a fraction of what is plausible, of a parameter that the drive shows."""
ROUNDS: Final = 3
MIN_FIXES: Final = 20
MIN_DISTANCE_M: Final = 100.0
_MIN_SD: Final = 1e-6

START: Final = ("start_x_m", "start_y_m", "start_heading_rad")
FIX_DELAY: Final = "fix_delay_s"
DRIFT: Final = "gyro_drift_radps2"


class _Kind(NamedTuple):
    """A parameter: how far off it may plausibly be, and what a drive needs to show it."""

    plausible: float
    is_fraction: bool
    needs: str


PARAMETERS: Final[Mapping[str, _Kind]] = {
    "wheel_scale": _Kind(0.05, False, "a longer drive"),
    "gyro_bias_radps": _Kind(0.01, False, "a longer drive"),
    DRIFT: _Kind(1e-5, False, "a longer drive"),
    "yaw_rate_scale": _Kind(0.05, False, "turns"),
    "steering_ratio": _Kind(0.2, True, "turns"),
    "steering_offset_rad": _Kind(0.1, False, "a longer drive"),
    "wheelbase_m": _Kind(0.05, True, "tight turns: in wide ones it looks like the steering ratio"),
    "right_wheel_scale": _Kind(0.01, False, "a longer drive"),
    "track_width_m": _Kind(0.1, True, "turns"),
    "turn_delay_s": _Kind(0.2, False, "turns"),
    FIX_DELAY: _Kind(0.5, False, "changes of speed"),
    "start_x_m": _Kind(10.0, False, ""),
    "start_y_m": _Kind(10.0, False, ""),
    "start_heading_rad": _Kind(0.5, False, ""),
}
OF_TURN: Final[Mapping[str, tuple[str, ...]]] = {
    "yaw rate": ("gyro_bias_radps", DRIFT, "yaw_rate_scale", "turn_delay_s"),
    "steering": ("steering_ratio", "steering_offset_rad", "wheelbase_m", "turn_delay_s"),
    "wheels": ("right_wheel_scale", "track_width_m"),
}
"""By what turns the pose."""
TURN_NOISE: Final[Mapping[str, str]] = {
    "yaw rate": "gyro_noise_rad_per_sqrt_s",
    "steering": "steering_noise_rad_sqrt_m",
    "wheels": "wheel_turn_rad_per_sqrt_m",
}


class Fitted(NamedTuple):
    """One parameter that the drive showed."""

    parameter: str
    given: float
    value: float
    sd: float


@dataclass(frozen=True, slots=True)
class OdometryFit:
    """A fitted car.

    Attributes:
        source: What turned the pose: "yaw rate", "steering" or "wheels".
        settings: With the fitted values and noise; the rest as given.
        fitted: What the drive showed: value and s.d. The gyro's drift and the delay of the
            positions are stated here alone.
        not_observable: What it did not show, and what it would take.
        start: Pose of the rear axle at the first position, with the covariance of the fit.
        start_ns: When.
        fix_sd_m: S.d. of the positions, by the residuals.
        residual_rms: Of the whitened residuals; 1 is right.
        fixes: Used.
        outliers: Of those, further off than one good position in a thousand is.
    """

    source: str
    settings: OdometrySettings
    fitted: tuple[Fitted, ...]
    not_observable: tuple[NotObservable, ...]
    start: State
    start_ns: int
    fix_sd_m: float
    residual_rms: float
    fixes: int
    outliers: int

    def value(self, parameter: str, otherwise: float = 0.0) -> float:
        """A fitted value; ``otherwise`` where the drive did not show it."""
        return next((one.value for one in self.fitted if one.parameter == parameter), otherwise)


def fit_odometry(
    wheels: WheelSpeeds,
    turn: TurnSignal | None,
    fixes: Fixes,
    lever_m: tuple[float, float],
    given: OdometrySettings,
    whole_s: float | None = None,
) -> OdometryFit:
    """Fit scale, biases, geometry, delays and noise to known positions.

    Args:
        wheels: The drive's wheel speeds.
        turn: Yaw rate or steering; None fits the wheels' difference.
        fixes: Positions in a plane map frame, in order of time. Their covariances count relative
            to each other: how good they are is fitted.
        lever_m: The point they are of, ahead of and to the left of the rear axle.
        given: Where to begin, and what stays if the drive does not show it.
        whole_s: For a drive of this length the noise covers what the fit leaves uncertain; None:
            as long as the fitted one.

    Raises:
        VehicleError: Too few positions, or too short a way.
    """
    drive = _Drive(wheels, turn, _covered(wheels, turn, fixes), lever_m)
    drive.check(given)
    names = _free(drive, given)
    fit = _Fit(drive, names, given, 1.0)
    values = fit.solve(fit.first_guess())
    missing: list[NotObservable] = []
    for _ in range(ROUNDS):
        fit = fit.with_noise(values)
        values = fit.solve(values)
        keep, lost = fit.observable(values)
        if lost:
            missing += lost
            values = {name: values[name] for name in keep}
            fit = replace(fit, names=keep)
            values = fit.solve(values)
    return _result(fit, values, given, tuple(missing), whole_s)


class Steps(NamedTuple):
    """Odometry cut at the positions and into arcs between them.

    Attributes:
        at_fix: Shape (M,): the position at the arc's end, or -1.
        distance_m: Shape (M,).
        turn_rad: Shape (M,).
        distance_var_m2: Shape (M,).
        turn_var_rad2: Shape (M,).
    """

    at_fix: Int64s
    distance_m: Floats
    turn_rad: Floats
    distance_var_m2: Floats
    turn_var_rad2: Floats


def residuals(
    start: State,
    steps: Steps,
    xy_m: Floats,
    cov_m2: Floats,
    lever_m: tuple[float, float],
    is_fused: bool = True,
) -> tuple[Floats, Floats]:
    """What positions differ from the filter's prediction, whitened by its covariance.

    Args:
        start: At the first position.
        steps: From there on.
        xy_m: Shape (N, 2).
        cov_m2: Shape (N, 2, 2).
        lever_m: The point they are of.
        is_fused: Let the filter weigh each position in; else it dead reckons.

    Returns:
        Whitened residuals, shape (N, 2), and the logarithm of each covariance's determinant, (N,).
    """
    ahead, left = lever_m
    white, log_det = np.empty((len(xy_m), 2)), np.empty(len(xy_m))
    fixes, covs = xy_m.tolist(), cov_m2.tolist()
    state = start
    columns = (column.tolist() for column in steps)
    for k, distance, turn, distance_var, turn_var in zip(*columns, strict=True):
        state = predict(state, distance, turn, distance_var, turn_var, 0.0)
        if k < 0:
            continue
        (x, y), ((var_x, cov_xy), (_, var_y)) = fixes[k], covs[k]
        seen = at_point(state, ahead, left)
        sxx, sxy, syy = seen.xx + var_x, seen.xy + cov_xy, seen.yy + var_y
        first = math.sqrt(sxx)
        second = math.sqrt(syy - sxy * sxy / sxx)
        along = (x - seen.x_m) / first
        across = (y - seen.y_m - sxy / first * along) / second
        white[k] = along, across
        log_det[k] = 2.0 * math.log(first * second)
        if is_fused:
            # An outlier counts as a position that bad, without a jump at the gate.
            more = max((along * along + across * across) / GATE_NIS, 1.0)
            after = update_position(seen, x, y, more * var_x, more * cov_xy, more * var_y, math.inf)
            state = at_point(after.state, -ahead, -left)
    return white, log_det


class _Drive:
    """A drive's measurements."""

    def __init__(
        self,
        wheels: WheelSpeeds,
        turn: TurnSignal | None,
        fixes: Fixes,
        lever_m: tuple[float, float],
    ) -> None:
        self.wheels, self.turn, self.fixes, self.lever_m = wheels, turn, fixes, lever_m
        self.source = "wheels" if turn is None else turn.kind
        self.seconds = (fixes.t_ns - fixes.t_ns[0]) * 1e-9 if len(fixes) else np.empty(0)
        knots, at = [np.zeros(1)], [np.zeros(1, np.int64)]
        for k, (before, after) in enumerate(
            zip(self.seconds[:-1].tolist(), self.seconds[1:].tolist(), strict=True), start=1
        ):
            parts = max(math.ceil((after - before) / STEP_S), 1)
            knots.append(np.linspace(before, after, parts + 1)[1:])
            at.append(np.array([-1] * (parts - 1) + [k]))
        self.knots_s, self.at_fix = np.concatenate(knots), np.concatenate(at)

    def check(self, given: OdometrySettings) -> None:
        """Refuse a drive that shows nothing.

        Raises:
            VehicleError: With what there is.
        """
        n = len(self.fixes)
        if n < MIN_FIXES:
            raise VehicleError(
                f"odometry: {n} positions lie within the wheel speeds, {MIN_FIXES} are wanted; "
                "take a longer drive"
            )
        gone_m = float(np.abs(self.steps(given, 0.0, 0.0).distance_m).sum())
        if gone_m < MIN_DISTANCE_M:
            raise VehicleError(
                f"odometry: the car went {gone_m:.0f} m while its position is known, "
                f"{MIN_DISTANCE_M:.0f} m are wanted; take a longer drive"
            )

    def steps(self, settings: OdometrySettings, drift: float, delay_s: float) -> Steps:
        """Odometry between the positions, stamped ``delay_s`` after they were true."""
        turn = self.turn
        if turn is not None and drift:
            middle_s = (turn.t_ns - self.fixes.t_ns[0]) * 1e-9 - 0.5 * self.seconds[-1]
            turn = TurnSignal(turn.t_ns, turn.values - drift * middle_s, turn.kind)
        made = integrate(self.wheels, settings, turn).increments
        edges_s = (np.append(made.start_ns[:1], made.stop_ns) - self.fixes.t_ns[0]) * 1e-9
        at_s = self.knots_s - delay_s

        def between(column: Floats) -> Floats:
            summed = np.append(0.0, np.cumsum(column))
            return np.diff(np.interp(at_s, edges_s, summed), prepend=np.interp(at_s[0], edges_s, summed))

        return Steps(
            self.at_fix,
            between(made.distance_m),
            between(made.turn_rad),
            between(made.distance_var_m2),
            between(made.turn_var_rad2),
        )

    def start(self, settings: OdometrySettings) -> State:
        """A first guess of the pose at the first position."""
        made = integrate(self.wheels, settings, self.turn).increments
        return start_pose(made, self.fixes, self.lever_m)


def _covered(wheels: WheelSpeeds, turn: TurnSignal | None, fixes: Fixes) -> Fixes:
    """Positions while everything speaks, a little inside because of the delays fitted."""
    spans = [wheels.t_ns] + ([] if turn is None else [turn.t_ns])
    if any(len(t_ns) < 2 for t_ns in spans):
        return fixes.take(slice(0, 0))
    first, last = max(int(t[0]) for t in spans), min(int(t[-1]) for t in spans)
    return fixes.take((fixes.t_ns >= first) & (fixes.t_ns <= last))


def _free(drive: _Drive, given: OdometrySettings) -> tuple[str, ...]:
    names = ("wheel_scale", *OF_TURN[drive.source], FIX_DELAY, *START)
    speeds = drive.wheels.wheels_mps
    one_speed = bool(np.array_equal(speeds[:, -2], speeds[:, -1]))
    if drive.source == "wheels" and one_speed:
        raise VehicleError(
            "odometry: left and right wheels report one speed, and there is neither yaw rate nor "
            "steering; name one of them in the vehicle file"
        )
    return tuple(name for name in names if name != "wheelbase_m" or given.wheelbase_m is not None)


Values = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class _Fit:
    """One state of the fit: what is free, and the noise taken for the weights."""

    drive: _Drive
    names: tuple[str, ...]
    given: OdometrySettings
    fix_scale: float

    def first_guess(self) -> Values:
        start = self.drive.start(self.given)
        at = dict(zip(START, (start.x_m, start.y_m, start.heading_rad), strict=True))
        return {name: at.get(name, _given(self.given, name)) for name in self.names}

    def settings(self, values: Values) -> OdometrySettings:
        own = {name: value for name, value in values.items() if hasattr(self.given, name)}
        return replace(self.given, **own)

    def whitened(self, values: Values) -> tuple[Floats, Floats]:
        drive = self.drive
        steps = drive.steps(
            self.settings(values), values.get(DRIFT, 0.0), values.get(FIX_DELAY, 0.0)
        )
        x, y, heading = (values[name] for name in START)
        start = State(x, y, heading, *(0.0,) * 11)
        cov = drive.fixes.cov_m2 * self.fix_scale**2
        return residuals(start, steps, drive.fixes.xy_m, cov, drive.lever_m)

    def solve(self, values: Values) -> Values:
        """The most likely values under the present noise."""
        from scipy.optimize import least_squares

        origin, unit = self._origin(values), self._units()
        found = least_squares(
            lambda p: self.whitened(self._values(p, origin, unit))[0].ravel(),
            np.ones(len(self.names)),
            loss="soft_l1",
            f_scale=LOSS_SD,
            diff_step=1e-4,
            xtol=1e-6,
            ftol=1e-6,
            gtol=1e-6,
            max_nfev=30,
        )
        return self._values(found.x, origin, unit)

    def information(self, values: Values) -> Floats:
        """Of the parameters in units of what is plausible, by the residuals' derivatives."""
        from scipy.optimize import least_squares

        origin, unit = self._origin(values), self._units()
        at = least_squares(
            lambda p: self.whitened(self._values(p, origin, unit))[0].ravel(),
            np.ones(len(self.names)),
            loss="soft_l1",
            f_scale=LOSS_SD,
            diff_step=1e-4,
            max_nfev=1,
        )
        return np.asarray(at.jac.T @ at.jac)

    def covariance(self, values: Values) -> Floats:
        """Of the parameters in their own units; residuals that hang together count as few."""
        white, _ = self.whitened(values)
        t_ns = self.drive.fixes.t_ns
        independent = min(persistence(t_ns, white[:, i]).independent for i in range(2))
        excess = max(float(np.median(white**2)) / 0.455, 1.0)
        unit = self._units()
        inverse = np.linalg.pinv(self.information(values), hermitian=True)
        return inverse * np.outer(unit, unit) * excess * len(t_ns) / independent

    def observable(self, values: Values) -> tuple[tuple[str, ...], list[NotObservable]]:
        """The names that the drive determines, and the others; the worst goes first."""
        kept = list(self.names)
        full = self.information(values)
        lost: list[NotObservable] = []
        while True:
            rows = [self.names.index(name) for name in kept]
            inverse = np.linalg.pinv(full[np.ix_(rows, rows)] + 1e-12 * np.eye(len(rows)))
            sd = np.sqrt(np.diagonal(inverse))
            own = [i for i, name in enumerate(kept) if name not in START]
            worst = max(own, key=lambda i: float(sd[i]), default=None)
            if worst is None or sd[worst] <= DETERMINED:
                return tuple(kept), lost
            name = kept.pop(worst)
            reach = float(sd[worst]) * self._units()[self.names.index(name)]
            sure = f"s.d. {reach:.2g} from this drive" if reach < 1e4 else "no effect on this drive"
            lost.append(NotObservable(name, f"{sure}; it needs {PARAMETERS[name].needs}"))

    def with_noise(self, values: Values) -> _Fit:
        """The noise under which these residuals are most likely."""
        from scipy.optimize import minimize

        names = ("slip_per_sqrt_m", TURN_NOISE[self.drive.source])
        begin = [max(getattr(self.given, name), _MIN_SD) for name in names] + [self.fix_scale]

        def at(logs: Floats) -> _Fit:
            *noise, scale = np.exp(logs).tolist()
            return replace(
                self,
                given=replace(self.given, **dict(zip(names, noise, strict=True))),
                fix_scale=scale,
            )

        def unlikely(logs: Floats) -> float:
            white, log_det = at(logs).whitened(values)
            nis = np.sum(white**2, axis=1)
            far = np.sqrt(np.maximum(nis * GATE_NIS, 0.0))
            robust = np.where(nis > GATE_NIS, 2.0 * far - GATE_NIS, nis)
            return 0.5 * float(np.sum(robust + log_det))

        found = minimize(
            unlikely, np.log(begin), method="Nelder-Mead",
            options={"xatol": 0.02, "fatol": 0.02, "maxfev": 200},
        )  # fmt: skip
        return at(found.x)

    def _origin(self, values: Values) -> Floats:
        return np.array([values[name] for name in self.names])

    def _units(self) -> Floats:
        return np.array(
            [
                kind.plausible * (abs(_given(self.given, name)) if kind.is_fraction else 1.0)
                for name, kind in ((name, PARAMETERS[name]) for name in self.names)
            ]
        )

    def _values(self, p: Floats, origin: Floats, unit: Floats) -> Values:
        # About 1 and not 0, so that finite differences know how large a step is.
        return dict(zip(self.names, (origin + (p - 1.0) * unit).tolist(), strict=True))


def _given(settings: OdometrySettings, name: str) -> float:
    return float(getattr(settings, name, 0.0))


def _result(
    fit: _Fit,
    values: Values,
    given: OdometrySettings,
    missing: tuple[NotObservable, ...],
    whole_s: float | None,
) -> OdometryFit:
    drive = fit.drive
    cov = fit.covariance(values)
    sd = {name: math.sqrt(float(cov[i, i])) for i, name in enumerate(fit.names)}
    white, _ = fit.whitened(values)
    at = [fit.names.index(name) for name in START]
    (xx, xy, xh), (_, yy, yh), (_, _, hh) = cov[np.ix_(at, at)].tolist()
    x, y, heading = (values[name] for name in START)
    position_var = float(np.mean(np.trace(drive.fixes.cov_m2, axis1=1, axis2=2))) / 2.0
    settings = fit.settings(values)
    steps = drive.steps(settings, 0.0, values.get(FIX_DELAY, 0.0))
    factor = 1.0 if whole_s is None else max(whole_s / float(drive.seconds[-1]), 1.0)
    return OdometryFit(
        source=drive.source,
        settings=_with_doubt(settings, steps, sd, float(drive.seconds[-1]) * factor, factor),
        fitted=tuple(
            Fitted(name, _given(given, name), values[name], sd[name])
            for name in fit.names
            if name not in START
        ),
        not_observable=missing,
        start=State(x, y, wrap(heading), 0.0, xx, xy, xh, 0.0, yy, yh, 0.0, hh, 0.0, 0.0),
        start_ns=int(drive.fixes.t_ns[0]),
        fix_sd_m=fit.fix_scale * math.sqrt(position_var),
        residual_rms=float(np.sqrt(np.mean(white**2))),
        fixes=len(drive.fixes),
        outliers=int((np.sum(white**2, axis=1) > GATE_NIS).sum()),
    )


def _with_doubt(
    settings: OdometrySettings, steps: Steps, sd: Values, seconds: float, factor: float
) -> OdometrySettings:
    """Noise that covers, at the end of a drive as long, what the fit leaves uncertain.

    A filter without a state for them cannot know that scales and biases stay wrong all drive long.
    """
    way_m = float(np.abs(steps.distance_m).sum()) * factor
    turned_rad = float(np.abs(steps.turn_rad).sum()) * factor
    ratio, base = settings.steering_ratio, settings.wheelbase_m or 1.0
    scales = (
        sd.get("yaw_rate_scale", 0.0),
        sd.get("steering_ratio", 0.0) / ratio,
        sd.get("wheelbase_m", 0.0) / base,
        sd.get("track_width_m", 0.0) / settings.track_width_m,
    )
    more = {
        "slip_per_sqrt_m": sd.get("wheel_scale", 0.0) * math.sqrt(way_m),
        "gyro_noise_rad_per_sqrt_s": math.hypot(
            sd.get("gyro_bias_radps", 0.0), 0.5 * sd.get(DRIFT, 0.0) * seconds
        )
        * math.sqrt(seconds),
        "steering_noise_rad_sqrt_m": sd.get("steering_offset_rad", 0.0) / ratio * math.sqrt(way_m),
        "wheel_turn_rad_per_sqrt_m": sd.get("right_wheel_scale", 0.0)
        / settings.track_width_m
        * math.sqrt(way_m),
        "turn_rad_per_sqrt_rad": math.hypot(*scales) * math.sqrt(turned_rad),
    }
    return replace(
        settings,
        **{name: math.hypot(getattr(settings, name), doubt) for name, doubt in more.items()},
    )
