"""Consistency checks between signals that measure the same motion.

A speed is compared with GNSS or the other wheels. A yaw rate is compared with the course over
ground, the steering wheel and the difference of the rear wheels. Each comparison allows for the
expected error of its reference. A contradicting signal is never proposed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .series import STEPS, WINDOW_S, Grid, GroundTrack, Series

DEGREE: Final = math.pi / 180.0
MAX_SPEED_MPS: Final = 100.0
MAX_STEERING_RAD: Final = 1000.0 * DEGREE
MAX_YAW_RATE_RADPS: Final = 2.0
MOVING_MPS: Final = 3.0
STANDING_MPS: Final = 0.05
TRACK_M: Final = 1.55
STEERING_RATIO: Final = 15.0
WHEELBASE_M: Final = 2.7
# Maximum plausible bias of a car's gyro; ``fit odometry`` removes it.
GYRO_BIAS_RADPS: Final = 1.0 * DEGREE
# Maximum plausible steering offset on a straight road (crowned road, side wind).
STEERING_OFF_RAD: Final = 4.0 * DEGREE
# Maximum plausible relative difference between left and right wheels: of radii, and by slip.
TYRES_DIFFER: Final = 0.02
# Minimum turn of a reference, in any window, that determines the sign and scale.
TURNS: Final = 3.0 * DEGREE
FOLLOWS: Final = 0.7
MIN_WINDOWS: Final = 5
# Number of windows for which a correlation is significant, however little the car turns.
SURE_WINDOWS: Final = 15


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """A reference for the turns of the car.

    Attributes:
        name: Name of the reference in facts.
        turned_rad: Shape (windows,): turn within each window; NaN where unknown.
        off_radps: Shape (windows,): plausible error of its rate.
        has_scale: True if its scale is known.
    """

    name: str
    turned_rad: NDArray[np.float64]
    off_radps: NDArray[np.float64]
    has_scale: bool = True


@dataclass(frozen=True, slots=True)
class SignalVerdict:
    """Result of the consistency checks of a signal.

    Attributes:
        facts: Observations, for the comment next to the signal.
        wrong: Reasons against its use; empty if there is no contradiction.
        agrees_with: Number of references that it agrees with.
        error: Deviation from the references, used for ranking.
        sign: -1 if it is positive to the right, else 1.
        is_judged: False if the log contains too little data for a comparison.
    """

    facts: tuple[str, ...]
    wrong: tuple[str, ...] = ()
    agrees_with: int = 0
    error: float = math.inf
    sign: int = 1
    is_judged: bool = False

    @property
    def rank(self) -> tuple[int, float]:
        """Sort key; smaller is better."""
        return -self.agrees_with, self.error


def judge_speed(
    series: Series, reference: Series | None, grid: Grid, radius_known: bool
) -> SignalVerdict:
    """Check a speed, or a wheel's angular rate if its radius is unknown, against a reference.

    Args:
        series: Readings of the signal.
        reference: An independent speed, m/s; None if unknown.
        grid: The times of the comparison.
        radius_known: True if the series is in m/s, so that its scale is checked too.
    """
    low, high = float(series.values.min()), float(series.values.max())
    unit = "m/s" if radius_known else "rad/s"
    facts = [f"{series.rate_hz:.3g} Hz", f"{low:.1f} to {high:.1f} {unit}"]
    limit = MAX_SPEED_MPS if radius_known else MAX_SPEED_MPS / 0.2
    if max(abs(low), abs(high)) > limit:
        return SignalVerdict(tuple(facts), (f"reaches {max(abs(low), abs(high)):.0f} {unit}",))
    if reference is None:
        return SignalVerdict(tuple(facts))
    measured, true = series.at(grid), reference.at(grid)
    both = np.isfinite(measured) & np.isfinite(true)
    if both.sum() < 50 or float(np.abs(true[both]).max()) < MOVING_MPS:
        return SignalVerdict((*facts, f"too little motion in common with {reference.name}"))
    measured, true = np.abs(measured[both]), np.abs(true[both])
    if not measured.any():
        return SignalVerdict(tuple(facts), (f"is 0 while {reference.name} moves",))
    scale = float((true * measured).sum() / (measured * measured).sum())
    rms_mps = float(np.sqrt(np.mean((scale * measured - true) ** 2)))
    if radius_known:
        facts.append(f"{rms_mps:.2g} m/s from {reference.name} (times {scale:.4g})")
        wrong = not 0.85 <= scale <= 1.15
    else:
        facts.append(f"{rms_mps:.2g} m/s from {reference.name} with a radius of {scale:.4g} m")
        wrong = not 0.2 <= scale <= 0.6
    if wrong or rms_mps > max(0.5, 0.05 * float(true.max())):
        return SignalVerdict(tuple(facts), ("contradicts it",), error=rms_mps, is_judged=True)
    return SignalVerdict(tuple(facts), agrees_with=1, error=rms_mps, is_judged=True)


def spread_mps(wheels: Sequence[Series], grid: Grid) -> float:
    """Return the RMS deviation of the wheels from their mean; NaN without common times."""
    stacked = np.stack([one.at(grid) for one in wheels])
    together = np.isfinite(stacked).all(axis=0)
    if not together.any():
        return math.nan
    off = stacked[:, together] - stacked[:, together].mean(axis=0)
    return float(np.sqrt(np.mean(off**2)))


def of_course(track: GroundTrack, grid: Grid) -> Turning | None:
    """Return the course over ground as a reference; None if the car was too slow."""
    if track.course is None:
        return None
    turned = np.diff(track.course.at(grid)[::STEPS])
    return Turning(f"the course of {track.course.name}", turned, np.zeros(grid.windows))


def of_wheels(left: Series, right: Series, grid: Grid) -> Turning:
    """Return the difference of an axle's wheels as a reference, with a typical track width."""
    rate = (right.at(grid) - left.at(grid)) / TRACK_M
    speed = 0.5 * (right.at(grid) + left.at(grid))
    off = TYRES_DIFFER * np.abs(grid.mean(speed)) / TRACK_M
    return Turning("the rear wheels", grid.mean(rate) * WINDOW_S, off)


def of_steering(angle: Series, sign: int, speed: Series, grid: Grid) -> Turning:
    """Return the steering angle as a reference, with a typical steering ratio and wheelbase."""
    v = speed.at(grid)
    rate = sign * v * np.tan(np.clip(angle.at(grid) / STEERING_RATIO, -1.0, 1.0)) / WHEELBASE_M
    off = np.abs(grid.mean(v)) * STEERING_OFF_RAD / STEERING_RATIO / WHEELBASE_M
    return Turning(f"steering {angle.name}", grid.mean(rate) * WINDOW_S, off, has_scale=False)


def of_rate(rate: Series, sign: int, grid: Grid) -> Turning:
    """Return a yaw rate that agrees with other references as a reference."""
    off = np.full(grid.windows, GYRO_BIAS_RADPS)
    return Turning(f"the yaw rate of {rate.name}", sign * rate.turned(grid), off)


def judge_yaw_rate(
    series: Series, references: Sequence[Turning], speed: Series | None, grid: Grid
) -> SignalVerdict:
    """Check a yaw rate against references.

    Args:
        series: Readings of the signal, rad/s.
        references: References, best first.
        speed: Speed of the car, m/s, to detect when it is stationary.
        grid: The times of the comparison.
    """
    found = _range_verdict(series, MAX_YAW_RATE_RADPS, "deg/s")
    if found.wrong:
        return found
    if speed is not None and (bias := _bias(series, speed, grid)) is not None:
        text = f"{bias / DEGREE:+.2f} deg/s while the car is stationary"
        found = replace(found, facts=(*found.facts, text))
        if abs(bias) > GYRO_BIAS_RADPS:
            found = replace(found, wrong=(*found.wrong, "turns while the car is stationary"))
    return _judged(found, series.turned(grid), references, GYRO_BIAS_RADPS)


def judge_steering(
    series: Series, references: Sequence[Turning], speed: Series | None, grid: Grid
) -> SignalVerdict:
    """Check a steering angle of unknown steering ratio against references."""
    found = _range_verdict(series, MAX_STEERING_RAD, "deg")
    if found.wrong or speed is None:
        return found
    as_turn = of_steering(series, 1, speed, grid)
    scaleless = [replace(one, has_scale=False) for one in references]
    # An offset of the steering wheel is not a contradiction; only the turns must correlate.
    return _judged(found, as_turn.turned_rad, scaleless, math.inf)


def _range_verdict(series: Series, limit_rad: float, unit: str) -> SignalVerdict:
    low, high = float(series.values.min()) / DEGREE, float(series.values.max()) / DEGREE
    facts = (f"{series.rate_hz:.3g} Hz", f"{low:.1f} to {high:.1f} {unit}")
    if max(abs(low), abs(high)) * DEGREE > limit_rad:
        return SignalVerdict(facts, (f"reaches {max(abs(low), abs(high)):.0f} {unit}",))
    if low == high:
        return SignalVerdict(facts, ("never changes",))
    return SignalVerdict(facts)


def _bias(series: Series, speed: Series, grid: Grid) -> float | None:
    """Return the mean rate while the car is stationary for two seconds or more."""
    stands = grid.windows_where(np.abs(speed.at(grid)) < STANDING_MPS)
    turned = series.turned(grid)[stands]
    turned = turned[np.isfinite(turned)]
    return float(turned.mean() / WINDOW_S) if len(turned) else None


def _judged(
    found: SignalVerdict,
    turned: NDArray[np.float64],
    references: Sequence[Turning],
    bias_radps: float,
) -> SignalVerdict:
    facts, wrong = [*found.facts], [*found.wrong]
    agrees, error, sign, is_judged = 0, math.inf, 1, False
    for reference in references:
        both = np.isfinite(turned) & np.isfinite(reference.turned_rad)
        if both.sum() < MIN_WINDOWS:
            continue
        mine, other = turned[both], reference.turned_rad[both]
        follows = _correlation(mine, other)
        is_turning = float(np.abs(other - np.median(other)).max()) >= TURNS
        by_error = reference.off_radps[both] * WINDOW_S + TURNS
        is_explained = reference.has_scale and bool((np.abs(mine - other) < by_error).all())
        if is_turning or (abs(follows) >= FOLLOWS and both.sum() >= SURE_WINDOWS):
            text = f"correlation {follows:+.2f} with {reference.name}"
            if not is_judged and follows <= -FOLLOWS:
                sign = -1
            is_judged = True
            if sign * follows < FOLLOWS:
                facts.append(text)
                wrong += [] if is_explained else [f"does not follow {reference.name}"]
                continue
            ratio = float(np.std(mine) / np.std(other))
            facts.append(text + (f" (times {ratio:.2f})" if reference.has_scale else ""))
            if is_turning and reference.has_scale and not 0.6 <= ratio <= 1.6:
                text = f"turns {ratio:.2g} times as far as {reference.name}"
                wrong += [] if is_explained else [text]
                continue
            agrees += 1
        off = float((sign * mine - other).mean()) / WINDOW_S
        may_be = bias_radps + float(reference.off_radps[both].mean())
        if abs(off) > may_be:
            wrong.append(
                f"turns {sign * mine.sum() / DEGREE:.0f} deg in all where {reference.name} turns "
                f"{other.sum() / DEGREE:.0f} deg"
            )
        elif not math.isfinite(error):
            error = abs(off)
            is_judged = True
            if math.isfinite(bias_radps):
                facts.append(
                    f"{off / DEGREE:+.2f} deg/s off {reference.name} on average, "
                    f"over {both.sum() * WINDOW_S:.0f} s"
                )
    return SignalVerdict(tuple(facts), tuple(wrong), agrees, error, sign, is_judged)


def _correlation(mine: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    if float(np.std(mine)) == 0.0 or float(np.std(other)) == 0.0:
        return 0.0
    return float(np.corrcoef(mine, other)[0, 1])
