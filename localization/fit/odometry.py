"""Fit a car's odometry to a drive with known positions, and report the observable parameters.

The method is maximum likelihood by prediction errors (L. Ljung, *System Identification*, 2nd ed.,
section 7.4). The pose filter runs along the drive with trial parameters. The difference of each
position from the filter's prediction, in units of its covariance, is a residual of
``least_squares`` with a robust loss. Unlike residuals of dead reckoning, these are independent,
because each position corrects the accumulated error. The noise densities maximise the likelihood of
the residuals; the fits of parameters and noise alternate.

The inverse of the information matrix yields each parameter's variance. The unit of a parameter is
its plausible deviation for a car. A parameter whose s.d. exceeds a fraction of that is not
observable: it keeps its given value and is reported. The worst is removed first, and the others are
fitted again. If two parameters are observable only in combination (steering ratio and wheelbase),
one of them therefore remains as given.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from crosscue.localization.angles import wrap
from crosscue.localization.constants import DRIFTING, EFFECTS, TURN_PARAMETERS, Constants
from crosscue.localization.fit.compass import NotObservable, persistence
from crosscue.localization.fit.front_wheels import front_wheels
from crosscue.localization.fit.known_drive import GATE_NIS, Car, KnownDrive, Steps, whitened
from crosscue.localization.odometry import OdometrySettings
from crosscue.localization.pose_filter import State
from crosscue.replay.columns import Floats
from crosscue.replay.errors import VehicleError

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

# Residual at which the robust loss changes from squares to absolute values.
LOSS_SD: Final = 2.0
# Maximum s.d. of an observable parameter, as a fraction of its plausible deviation.
DETERMINED: Final = 0.5
# Minimum s.d. of a position of the rear axle, because the body leans and slips, and levers are
# measured by hand. Without it, a smooth track would count as perfect, and its sway as turns.
MIN_FIX_SD_M: Final = 0.1
# Fraction of it that limits the search for the most likely noise.
LEAST: Final = 0.05
# S.d. of a direction without information, in units of the plausible deviation.
NO_INFORMATION_SD: Final = 1e5
# S.d. in those units above which a parameter has no effect on the drive.
WITHOUT_EFFECT: Final = 1e3
# Maximum deviation from the given value in the fit, in units of the plausible deviation.
REACH: Final = 4.5
# Maximum number of alternations between fit and noise.
ROUNDS: Final = 8
# Relative change of the noise below which it has converged.
SETTLED: Final = 0.05
# Step of numerical derivatives, in units of the plausible deviation.
DERIVATIVE_STEP: Final = 1e-4
# Typical noise of a car without its constant errors, and the factor by which a car's plausibly
# differs.
TYPICAL: Final = OdometrySettings(track_width_m=1.5)
NOISE_FACTOR: Final = 3.0
# The same for the change of the positions' own error in one second: from a smoothed track of some
# centimetres to a phone among high buildings.
TYPICAL_WANDER_M: Final = 0.05
WANDER_FACTOR: Final = 10.0
# Typical change of the drifting parameters in one second; the steering's is of the road wheels.
TYPICAL_DRIFT: Final = {
    "wheel_scale": 2e-4,
    "gyro_bias_radps": 2e-5,
    "steering_offset_rad": 1e-4,
    "right_wheel_scale": 1e-5,
}
DRIFT_FACTOR: Final = 10.0
# Positions and distance with which anything is observable; more is judged by the parameters' s.d.
MIN_FIXES: Final = 5
MIN_DISTANCE_M: Final = 20.0
_MIN_SD: Final = 1e-6
# Factor of typical noise under which a drive with any plausible error of the car is likely.
WIDE: Final = 50.0
# Logarithm of noise beyond any car's.
_LOUD: Final = 2.0

START: Final = ("start_x_m", "start_y_m", "start_heading_rad")
FIX_DELAY: Final = "fix_delay_s"
FRONT: Final = ("front_left_scale", "front_right_scale")


class _Kind(NamedTuple):
    """A parameter: its plausible deviation, and the kind of drive that makes it observable."""

    plausible: float
    is_fraction: bool
    needs: str


PARAMETERS: Final[Mapping[str, _Kind]] = {
    "wheel_scale": _Kind(0.05, False, "a longer drive"),
    "gyro_bias_radps": _Kind(0.01, False, "a longer drive"),
    "yaw_rate_scale": _Kind(0.02, False, "turns"),
    "steering_ratio": _Kind(0.2, True, "turns"),
    "steering_offset_rad": _Kind(0.2, False, "a longer drive"),
    "understeer_s2pm2": _Kind(0.002, False, "turns at several speeds"),
    "wheelbase_m": _Kind(0.05, True, "tight turns: in wide ones it looks like the steering ratio"),
    "right_wheel_scale": _Kind(0.01, False, "a longer drive"),
    "track_width_m": _Kind(0.1, True, "turns"),
    "turn_delay_s": _Kind(0.2, False, "turns"),
    FIX_DELAY: _Kind(0.5, False, "changes of speed"),
    "start_x_m": _Kind(10.0, False, ""),
    "start_y_m": _Kind(10.0, False, ""),
    "start_heading_rad": _Kind(0.5, False, ""),
}
# Parameters by turn source, other than those that a filter takes for constant.
ALSO_OF_TURN: Final[Mapping[str, tuple[str, ...]]] = {
    "yaw rate": ("turn_delay_s",),
    "steering": ("turn_delay_s",),
    "wheels": (),
}
TURN_NOISE: Final[Mapping[str, str]] = {
    "yaw rate": "gyro_noise_rad_per_sqrt_s",
    "steering": "steering_noise_rad_sqrt_m",
    "wheels": "wheel_turn_rad_per_sqrt_m",
}


class Fitted(NamedTuple):
    """One fitted parameter."""

    parameter: str
    given: float
    value: float
    sd: float


@dataclass(frozen=True, slots=True)
class OdometryFit:
    """A fitted car.

    Attributes:
        source: Source of the change of heading: "yaw rate", "steering" or "wheels".
        settings: Settings with the fitted values and noise; the others as given.
        fitted: Value and s.d. of the observable parameters. The delay of the positions is only
            here, not in ``settings``.
        not_observable: Other parameters, and the kind of drive that they need.
        start: Pose of the rear axle at the first position, with the covariance of the fit.
        start_ns: Time of the first position.
        constants: Errors of the parameters, as states of a filter that starts with ``start``.
        fix_sd_m: S.d. of the positions, by the residuals.
        wander_m_per_sqrt_s: S.d. of the change of the positions' own error in one second.
        residual_rms: Root mean square of the whitened residuals; 1 if consistent.
        fixes: Number of positions used.
        outliers: Number of positions further off than 99.9 % of good positions.
    """

    source: str
    settings: OdometrySettings
    fitted: tuple[Fitted, ...]
    not_observable: tuple[NotObservable, ...]
    start: State
    start_ns: int
    constants: Constants
    fix_sd_m: float
    wander_m_per_sqrt_s: float
    residual_rms: float
    fixes: int
    outliers: int

    @property
    def car(self) -> Car:
        """The car, for dead reckoning on a drive with the same positions."""
        delay_s = self.value(FIX_DELAY)
        return Car(self.settings, self.constants, delay_s, self.fix_sd_m, self.wander_m_per_sqrt_s)

    def value(self, parameter: str, otherwise: float = 0.0) -> float:
        """Return a fitted value, or ``otherwise`` if it is not observable."""
        return next((one.value for one in self.fitted if one.parameter == parameter), otherwise)


def fit_odometry(drive: KnownDrive, given: OdometrySettings) -> OdometryFit:
    """Fit scale, biases, geometry, delays and noise to known positions.

    Args:
        drive: The drive. Only the ratios of its positions' covariances matter; their scale is
            fitted.
        given: Initial values, which parameters that are not observable keep.

    Raises:
        VehicleError: There are too few positions, the distance is too short, or no signal measures
            turns.
    """
    _check(drive, given)
    names = _free(drive, given)
    # Large noise at first: a filter that trusts a wrong bias diverges, and derivatives are useless.
    loud = {n: WIDE * getattr(TYPICAL, n) for n in ("slip_per_sqrt_m", TURN_NOISE[drive.source])}
    fit = _Fit(drive, names, _changed(given, loud), 1.0, WIDE * TYPICAL_WANDER_M, (0.0, 0.0))
    values = fit.solve(fit.first_guess())
    fit = replace(fit, given=given)
    values = fit.solve(values)
    missing: list[NotObservable] = []
    for _ in range(ROUNDS):
        before, fit = fit, fit.with_noise(values)
        values = fit.solve(values)
        keep, lost = fit.observable(values)
        if lost:
            missing += lost
            fit = replace(fit, names=keep)
            values = fit.solve({name: values[name] for name in keep})
        elif fit.is_like(before):
            break
    fit = fit.with_noise(values, is_upper=True)
    sd = fit.deviations(values)
    same = [name for name in _own(fit.names) if abs(values[name] - _given(given, name)) < sd[name]]
    if same:
        missing += [
            NotObservable(name, f"{values[name]:.2g} +- {sd[name]:.2g} from this drive; as given")
            for name in same
        ]
        fit = replace(fit, names=tuple(name for name in fit.names if name not in same))
        values = fit.solve({name: values[name] for name in fit.names})
    return _result(fit, names, values, given, tuple(missing))


def _own(names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the parameters other than the start pose."""
    return tuple(name for name in names if name not in START)


def _check(drive: KnownDrive, given: OdometrySettings) -> None:
    n = len(drive.fixes)
    if n < MIN_FIXES:
        raise VehicleError(
            f"odometry: {n} positions are within the wheel speeds; expected {MIN_FIXES} or more; "
            "use a longer drive"
        )
    gone_m = float(np.abs(drive.steps(given).distance_m).sum())
    if gone_m < MIN_DISTANCE_M:
        raise VehicleError(
            f"odometry: the car went {gone_m:.0f} m while its position is known; expected "
            f"{MIN_DISTANCE_M:.0f} m or more; use a longer drive"
        )


def _free(drive: KnownDrive, given: OdometrySettings) -> tuple[str, ...]:
    of_turn = (*TURN_PARAMETERS[drive.source], *ALSO_OF_TURN[drive.source])
    names = ("wheel_scale", *of_turn, FIX_DELAY, *START)
    speeds = drive.wheels.wheels_mps
    one_speed = bool(np.array_equal(speeds[:, -2], speeds[:, -1]))
    if drive.source == "wheels" and one_speed:
        raise VehicleError(
            "odometry: left and right wheels have the same speed, and yaw rate and steering are "
            "missing; name one of them in the vehicle file"
        )
    return tuple(name for name in names if name != "wheelbase_m" or given.wheelbase_m is not None)


Values: TypeAlias = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class _Fit:
    """One state of the fit: the free parameters, and the noise used for the weights."""

    drive: KnownDrive
    names: tuple[str, ...]
    given: OdometrySettings
    fix_scale: float
    wander_m_per_sqrt_s: float
    drift_per_sqrt_s: tuple[float, float]

    def first_guess(self) -> Values:
        start = self.drive.start(self.given)
        at = dict(zip(START, (start.x_m, start.y_m, start.heading_rad), strict=True))
        return {name: at.get(name, _given(self.given, name)) for name in self.names}

    def settings(self, values: Values) -> OdometrySettings:
        own = {name: value for name, value in values.items() if hasattr(self.given, name)}
        return _changed(self.given, own)

    def whitened(self, values: Values) -> tuple[Floats, Floats]:
        return self._seen(values, self._steps(values, {}), self.fix_scale)

    def _steps(self, values: Values, noise: Values) -> Steps:
        car = _changed(self.settings(values), noise)
        delay_s = values.get(FIX_DELAY, 0.0)
        names, drift_var = DRIFTING[self.drive.source], np.square(self.drift_per_sqrt_s)
        return self.drive.steps(car, delay_s, self.wander_m_per_sqrt_s, names, drift_var)

    def _seen(self, values: Values, steps: Steps, fix_scale: float) -> tuple[Floats, Floats]:
        mean = np.array([*(values[name] for name in START), 0.0, 0.0])
        fixes, cov = self.drive.fixes, self.drive.fixes.cov_m2 * fix_scale**2
        return whitened(self.drive.follow(mean, np.zeros((5, 5)), steps, cov), fixes.xy_m, cov)

    def solve(self, values: Values) -> Values:
        """Fit the most likely values under the current noise."""
        found = self._least_squares(values, max_nfev=30)
        return self._values(found.x, values)

    def information(self, values: Values) -> Floats:
        """Information matrix by the residuals' derivatives, in units of plausible deviations."""
        derivatives = self._least_squares(values, max_nfev=1).jac
        return np.asarray(derivatives.T @ derivatives)

    def _least_squares(self, values: Values, max_nfev: int) -> OptimizeResult:
        from scipy.optimize import least_squares

        low, high = self._bounds(values)
        return least_squares(
            lambda p: self.whitened(self._values(p, values))[0].ravel(),
            np.clip(np.ones(len(self.names)), low + 1e-6, high - 1e-6),
            bounds=(low, high),
            loss="soft_l1",
            f_scale=LOSS_SD,
            diff_step=DERIVATIVE_STEP,
            xtol=1e-6,
            ftol=1e-6,
            gtol=1e-6,
            max_nfev=max_nfev,
        )

    def per_sample(self, values: Values) -> float:
        """Variance of a residual per independent sample, where residuals are correlated."""
        white, _ = self.whitened(values)
        t_ns = self.drive.fixes.t_ns
        independent = min(persistence(t_ns, white[:, i]).independent for i in range(2))
        return max(float(np.median(white**2)) / 0.455 * len(t_ns) / independent, 1.0)

    def deviations(self, values: Values) -> dict[str, float]:
        """Standard deviations of the parameters in their own units."""
        inverse = _inverse(self.information(values)) * self.per_sample(values)
        sd = np.sqrt(np.diagonal(inverse)) * self._units()
        return dict(zip(self.names, sd.tolist(), strict=True))

    def mean_square_error(self, values: Values, given: OdometrySettings) -> Floats:
        """Expected products of the parameters' errors, also of those that keep their given values.

        Each parameter is plausibly as far from its given value as its unit; this prior and the
        residuals determine mean and covariance (one Gauss-Newton step). What keeps its given value
        is off by the mean's distance, too, and the others compensate for that.
        """
        found = self._least_squares(values, max_nfev=1)
        unit, samples = self._units(), self.per_sample(values)
        prior = np.array([0.0 if name in START else 1.0 for name in self.names])
        away = np.array([values[name] - _given(given, name) for name in self.names]) / unit
        cov = _inverse(found.jac.T @ found.jac / samples + np.diag(prior))
        off = cov @ (found.grad / samples + prior * away)
        return (cov + np.outer(off, off)) * np.outer(unit, unit)

    def observable(self, values: Values) -> tuple[tuple[str, ...], list[NotObservable]]:
        """Names of the observable parameters, and the others, removed from the worst on."""
        kept = list(self.names)
        full = self.information(values)
        lost: list[NotObservable] = []
        while True:
            rows = [self.names.index(name) for name in kept]
            sd = np.sqrt(np.diagonal(_inverse(full[np.ix_(rows, rows)])))
            own = [i for i, name in enumerate(kept) if name not in START]
            worst = max(own, key=lambda i: float(sd[i]), default=None)
            if worst is None or sd[worst] <= DETERMINED:
                return tuple(kept), lost
            name = kept.pop(worst)
            reach = float(sd[worst]) * self._units()[self.names.index(name)]
            sure = f"s.d. {reach:.2g} from this drive"
            if sd[worst] > WITHOUT_EFFECT:
                sure = "no effect on this drive"
            lost.append(NotObservable(name, f"{sure}; it needs {PARAMETERS[name].needs}"))

    def with_noise(self, values: Values, *, is_upper: bool = False) -> _Fit:
        """Fit the noise that is most likely by the residuals, and for a car.

        ``is_upper`` adds the noise's own s.d., because parameters fitted to the same residuals make
        these smaller.
        """
        from scipy.optimize import minimize

        slip, turn = self._noises()
        min_scale = MIN_FIX_SD_M / self.drive.fix_sd_m
        current = (*self._noise(), self.fix_scale)
        drift = [TYPICAL_DRIFT[name] for name in DRIFTING[self.drive.source]]
        drift[1] *= abs(self.given.steering_ratio) if self.drive.source == "steering" else 1.0
        typical = np.log([getattr(TYPICAL, slip), getattr(TYPICAL, turn), TYPICAL_WANDER_M, *drift])
        factor = np.log([NOISE_FACTOR] * 2 + [WANDER_FACTOR] + [DRIFT_FACTOR] * 2)
        # Variances are linear in the noise's, so odometry is integrated thrice and not hundredfold.
        silent = self._steps(values, {slip: 0.0, turn: 0.0})
        by_slip = self._steps(values, {slip: 1.0, turn: 0.0}).distance_var_m2
        by_turn = self._steps(values, {slip: 0.0, turn: 1.0}).turn_var_rad2

        def unlikely(logs: Floats) -> float:
            slip_var, turn_var, wander_var, *drift_var = np.exp(2.0 * logs[:5]).tolist()
            steps = silent._replace(
                distance_var_m2=silent.distance_var_m2
                + slip_var * (by_slip - silent.distance_var_m2),
                turn_var_rad2=silent.turn_var_rad2 + turn_var * (by_turn - silent.turn_var_rad2),
                wander_var_m2=wander_var * self.drive.dt_s,
                drift_var=np.outer(self.drive.dt_s, drift_var),
            )
            # Not the least s.d.: larger than the residuals, it would leave no noise to be seen.
            white, log_det = self._seen(values, steps, max(math.exp(logs[5]), LEAST * min_scale))
            nis = np.sum(white**2, axis=1)
            far = np.sqrt(np.maximum(nis * GATE_NIS, 0.0))
            robust = np.where(nis > GATE_NIS, 2.0 * far - GATE_NIS, nis)
            # Positions cannot tell small noise from none, but a car has some.
            apart = (logs[:5] - typical) / factor
            return 0.5 * float(np.sum(robust + log_det) + np.sum(apart**2))

        first = np.log(np.maximum(current, _MIN_SD))
        first[3:5] = np.maximum(first[3:5], typical[3:])
        simplex = np.vstack([first, first + np.diag([-1.0] * 6)])
        options = {"xatol": 0.02, "fatol": 0.02, "maxfev": 500, "initial_simplex": simplex}
        logs = minimize(unlikely, first, method="Nelder-Mead", options=options).x
        for i in range(3 if is_upper else 0):
            step = 0.05 * np.eye(6)[i]
            limit = unlikely(logs) + 0.5
            while logs[i] < _LOUD and unlikely(logs + step) < limit:
                logs = logs + step
        slip_sd, turn_sd, wander, *drift, scale = np.exp(logs).tolist()
        given = _changed(self.given, {slip: slip_sd, turn: turn_sd})
        return replace(
            self,
            given=given,
            fix_scale=max(scale, min_scale),
            wander_m_per_sqrt_s=wander,
            drift_per_sqrt_s=(drift[0], drift[1]),
        )

    def _noises(self) -> tuple[str, str]:
        return "slip_per_sqrt_m", TURN_NOISE[self.drive.source]

    def _noise(self) -> tuple[float, ...]:
        noise = (float(getattr(self.given, name)) for name in self._noises())
        return *noise, self.wander_m_per_sqrt_s, *self.drift_per_sqrt_s

    def is_like(self, other: _Fit) -> bool:
        """Whether the noise is about the same."""
        pairs = zip(
            (*self._noise(), self.fix_scale), (*other._noise(), other.fix_scale), strict=True
        )
        return all(abs(a - b) <= SETTLED * max(abs(a), abs(b), _MIN_SD) for a, b in pairs)

    def _units(self) -> Floats:
        return np.array([_unit(self.given, name) for name in self.names])

    def _bounds(self, values: Values) -> tuple[Floats, Floats]:
        """Bounds about the given values; a scale or a length must remain positive."""
        is_start = np.array([name in START for name in self.names])
        given = np.array([_given(self.given, name) for name in self.names])
        at = np.array([values[name] for name in self.names])
        middle = 1.0 + (given - at) / self._units()
        low, high = middle - REACH, middle + REACH
        return np.where(is_start, -np.inf, low), np.where(is_start, np.inf, high)

    def _values(self, p: Floats, origin: Values) -> Values:
        # About 1 and not 0, so that finite differences have a sensible step.
        away = (p - 1.0) * self._units()
        return {name: origin[name] + by for name, by in zip(self.names, away.tolist(), strict=True)}


def _given(settings: OdometrySettings, name: str) -> float:
    if name in FRONT:
        return float(settings.wheel_scales[FRONT.index(name)]) / settings.wheel_scale
    return float(getattr(settings, name, 0.0))


def _inverse(information: Floats) -> Floats:
    """Invert the information matrix; directions without information remain finite."""
    values, axes = np.linalg.eigh(information)
    inverse: Floats = (axes / np.maximum(values, 1.0 / NO_INFORMATION_SD**2)) @ axes.T
    return inverse


def _unit(settings: OdometrySettings, name: str) -> float:
    """Plausible deviation of a parameter."""
    kind = PARAMETERS[name]
    return kind.plausible * (abs(_given(settings, name)) if kind.is_fraction else 1.0)


def _result(
    fit: _Fit,
    names: tuple[str, ...],
    values: Values,
    given: OdometrySettings,
    missing: tuple[NotObservable, ...],
) -> OdometryFit:
    drive = fit.drive
    white, _ = fit.whitened(values)
    every = {name: values.get(name, _given(given, name)) for name in names}
    cov = replace(fit, names=names).mean_square_error(every, given)
    sd = dict(zip(names, np.sqrt(np.diagonal(cov)).tolist(), strict=True))
    at = [names.index(name) for name in START]
    (xx, xy, xh), (_, yy, yh), (_, _, hh) = cov[np.ix_(at, at)].tolist()
    x, y, heading = (values[name] for name in START)
    settings = fit.settings(values)
    span_ns = int(drive.fixes.t_ns[0]), int(drive.fixes.t_ns[-1])
    front = front_wheels(drive.wheels, drive.increments(settings), settings, span_ns)
    # Positions that are early by some time are wheel speeds that are late by it.
    rows = [i for i, name in enumerate(names) if name in EFFECTS or name == FIX_DELAY]
    sign = np.array([-1.0 if names[i] == FIX_DELAY else 1.0 for i in rows])
    constant = tuple("wheel_delay_s" if names[i] == FIX_DELAY else names[i] for i in rows)
    drifts = dict(zip(DRIFTING[drive.source], fit.drift_per_sqrt_s, strict=True))
    cross = np.vstack([cov[np.ix_(at, rows)], np.zeros(len(rows))]) * sign
    return OdometryFit(
        source=drive.source,
        settings=_changed(settings, {one.setting: one.scale for one in front}),
        fitted=(
            *(
                Fitted(name, _given(given, name), values[name], sd[name])
                for name in _own(fit.names)
            ),
            *(Fitted(one.setting, _given(given, one.setting), one.scale, one.sd) for one in front),
        ),
        not_observable=missing,
        start=State(x, y, wrap(heading), 0.0, xx, xy, xh, 0.0, yy, yh, 0.0, hh, 0.0, 0.0),
        start_ns=span_ns[0],
        constants=Constants(
            constant,
            np.zeros(len(rows)),
            cov[np.ix_(rows, rows)] * np.outer(sign, sign),
            cross,
            np.array([drifts.get(name, 0.0) ** 2 for name in constant]),
        ),
        fix_sd_m=fit.fix_scale * drive.fix_sd_m,
        wander_m_per_sqrt_s=fit.wander_m_per_sqrt_s,
        residual_rms=float(np.sqrt(np.mean(white**2))),
        fixes=len(drive.fixes),
        outliers=int((np.sum(white**2, axis=1) > GATE_NIS).sum()),
    )


def _changed(settings: OdometrySettings, values: Values) -> OdometrySettings:
    return OdometrySettings(**{**asdict(settings), **values})
