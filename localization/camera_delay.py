"""Delay of a camera's time stamps against a signal of the car, from what the pictures show.

While the car turns, the rotation from picture to picture is the integral of the yaw rate between
their times. Around a standstill, the static scene grows in the picture in proportion to the speed.
Both are fitted by least squares, with the delay, its drift, and the scale of the signal free. The
standard deviation of a delay that the drive does not determine is large. Errors of successive
pictures are correlated: their noise is white plus an Ornstein-Uhlenbeck process, whose share and
time scale are averaged over, weighted by the restricted likelihood of the residuals (Harville,
JASA 72, 1977).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import ColumnSet, Floats, Int64s
from crosscue.replay.safe_text import counted

Bools = NDArray[np.bool_]

# Largest delay that is searched, and the step of the search.
MAX_DELAY_S: Final = 1.0
STEP_S: Final = 0.02
# Change of the delay after the search.
ENDS_S: Final = 0.1
# A delay is observable if its 95 % interval is at most this wide to each side, and bounded, which
# shows gross errors, up to an s.d.
OBSERVABLE_S: Final = 0.015
BOUNDED_SD_S: Final = 0.05
# Least change of heading that is a turn: in less, pictures mostly show vibrations of the car, which
# are faster than the pictures come.
TURN_RAD: Final = np.radians(3.0)
MIN_PAIRS: Final = 20
# Shares of correlated noise in the noise, and its time scales.
SHARES: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9)
SCALES_S: Final = (0.25, 0.5, 1.0, 2.0, 4.0)
# Pictures this long before and after a standstill show how the motion begins and ends.
AROUND_S: Final = 2.5
# Shortest drive with a drift, and the s.d. of a drift before the drive.
DRIFT_FROM_S: Final = 30.0
DRIFT_SD: Final = 100e-6
# Longest time between two readings of a signal that is bridged.
MAX_GAP_S: Final = 0.5
# Time over which a signal is averaged for its slopes, so that its noise does not count as motion.
SMOOTH_S: Final = 0.3
# S.d. of the delay from the motion around a standstill because the scene changes.
STOP_SD_S: Final = 0.03
# S.d. of the growth at a standstill, and of the growth of a moving scene as a fraction.
GROWTH_SD: Final = 5e-4
SCENE_SD: Final = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class PictureMotion(ColumnSet):
    """What N pairs of successive pictures show of the car's motion, as columns.

    Attributes:
        start_ns: Time stamp of the earlier picture.
        t_ns: Time stamp of the later picture.
        turn_rad: Change of heading, counter-clockwise, by an assumed focal length; NaN if unknown.
        expansion: Growth of the static scene, in proportion to the distance; NaN if unknown.
        is_standing: True if nothing moves.
    """

    start_ns: Int64s
    t_ns: Int64s
    turn_rad: Floats
    expansion: Floats
    is_standing: Bools


@dataclass(frozen=True, slots=True)
class CameraDelay:
    """Delay of the pictures' time stamps relative to those of a signal.

    Attributes:
        signal: Signal that the pictures are compared with.
        delay_s: Delay in the middle of the drive; positive where pictures are stamped late.
        sd_s: Its standard deviation; infinite if the drive does not determine it.
        drift_ppm: Change of the delay, in microseconds a second; None for a short drive.
        drift_sd_ppm: Its standard deviation.
        pairs: Number of pairs of pictures used.
        scale: Turn by the pictures per turn by the signal; NaN for other signals.
        scale_sd: Its standard deviation.
    """

    signal: str
    delay_s: float = 0.0
    sd_s: float = np.inf
    drift_ppm: float | None = None
    drift_sd_ppm: float | None = None
    pairs: int = 0
    scale: float = np.nan
    scale_sd: float = np.inf

    @property
    def is_observable(self) -> bool:
        """True if the drive determines the delay to 15 ms."""
        return 1.96 * self.sd_s <= OBSERVABLE_S

    @property
    def is_bounded(self) -> bool:
        """True if the drive determines the delay well enough to show a gross error."""
        return self.sd_s <= BOUNDED_SD_S

    def __str__(self) -> str:
        if not self.is_bounded:
            return f"not observable by {self.signal}: straight and steady"
        drift = ""
        if self.drift_ppm is not None and self.drift_sd_ppm is not None:
            drift = f", drift {self.drift_ppm:+.0f} +- {1.96 * self.drift_sd_ppm:.0f} ppm"
        late = f"{self.delay_s * 1e3:+.0f} +- {1.96 * self.sd_s * 1e3:.0f} ms"
        coarse = "" if self.is_observable else f"; not observable to {OBSERVABLE_S * 1e3:.0f} ms"
        return f"{late} by {self.signal}, {counted(self.pairs, 'pair')} of pictures{drift}{coarse}"


def delay_by_yaw_rate(
    motion: PictureMotion, t_ns: Int64s, yaw_rate_radps: Floats, signal: str = "yaw rate"
) -> CameraDelay:
    """Fit the delay, scale and bias of a yaw rate to the rotation that the pictures show.

    Args:
        motion: Motion by the pictures.
        t_ns: Times of the signal, ascending.
        yaw_rate_radps: Its readings.
        signal: Its name.
    """
    pairs = motion.take(np.isfinite(motion.turn_rad))
    if len(pairs.turn_rad) and np.ptp(np.cumsum(pairs.turn_rad)) < TURN_RAD:
        return CameraDelay(signal)
    integral = _Integral.of(t_ns, yaw_rate_radps)
    return _fitted(signal, pairs, pairs.turn_rad, integral, None)


def delay_by_speed(motion: PictureMotion, t_ns: Int64s, speed_mps: Floats) -> CameraDelay:
    """Fit the delay of a speed to the growth of the scene around each standstill.

    Args:
        motion: Motion by the pictures.
        t_ns: Times of the signal, ascending.
        speed_mps: Its readings.
    """
    event, number, last_ns = np.full(len(motion.t_ns), -1), -1, -(1 << 62)
    changes = np.flatnonzero(np.diff(motion.is_standing.astype(np.int8))) + 1
    for edge_ns in motion.t_ns[changes].tolist():
        number += edge_ns - last_ns > 2e9 * AROUND_S
        last_ns = edge_ns
        event[np.abs(motion.t_ns - edge_ns) < AROUND_S * 1e9] = number
    known = np.isfinite(motion.expansion) & (event >= 0)
    pairs = motion.take(known)
    integral = _Integral.of(t_ns, np.abs(speed_mps))
    return _fitted("speed", pairs, pairs.expansion, integral, event[known])


def mean_delay(delays: Sequence[CameraDelay]) -> CameraDelay | None:
    """Return the weighted mean of the bounded delays; None if there is none."""
    found = [one for one in delays if one.is_bounded]
    if len(found) < 2:
        return found[0] if found else None
    weights = np.array([one.sd_s**-2 for one in found])
    delays_s = np.array([one.delay_s for one in found])
    delay_s = float((weights * delays_s).sum() / weights.sum())
    # Signals that contradict each other widen the mean.
    spread = float((weights * (delays_s - delay_s) ** 2).sum()) / (len(found) - 1)
    sd_s = float(weights.sum() ** -0.5) * max(1.0, spread**0.5)
    best = found[int(np.argmax(weights))]
    names = " and ".join(one.signal for one in found)
    return CameraDelay(names, delay_s, sd_s, best.drift_ppm, best.drift_sd_ppm, best.pairs)


class _Integral(NamedTuple):
    """A signal and its integral over time."""

    t_ns: Int64s
    values: Floats
    area: Floats

    @classmethod
    def of(cls, t_ns: Int64s, values: Floats) -> Self:
        t_ns, values = t_ns[np.isfinite(values)], values[np.isfinite(values)]
        later = np.concatenate([np.ones(min(len(t_ns), 1), np.bool_), np.diff(t_ns) > 0])
        t_ns, values = t_ns[later], values[later]
        steps = 0.5 * (values[1:] + values[:-1]) * np.diff(t_ns) * 1e-9
        return cls(t_ns, values, np.concatenate([[0.0], np.cumsum(steps)])[: len(t_ns)])

    def at(self, t_s: Floats, origin_ns: int) -> tuple[Floats, Floats]:
        """Return integral and smoothed signal at times from an origin; NaN outside and in gaps."""
        area = self._area(t_s, origin_ns)
        ends_s = (self.t_ns[[0, -1]] - origin_ns) * 1e-9
        before_s, after_s = (np.clip(t_s + 0.5 * side * SMOOTH_S, *ends_s) for side in (-1.0, 1.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            turned = self._area(after_s, origin_ns) - self._area(before_s, origin_ns)
            return area, turned / (after_s - before_s)

    def _area(self, t_s: Floats, origin_ns: int) -> Floats:
        knots_s = (self.t_ns - origin_ns) * 1e-9
        after = np.clip(np.searchsorted(knots_s, t_s), 1, len(knots_s) - 1)
        width_s = knots_s[after] - knots_s[after - 1]
        part = (t_s - knots_s[after - 1]) / width_s
        value = self.values[after - 1] * (1.0 - part) + self.values[after] * part
        area = self.area[after - 1] + 0.5 * (self.values[after - 1] + value) * part * width_s
        known = (t_s >= knots_s[0]) & (t_s <= knots_s[-1]) & (width_s <= MAX_GAP_S)
        return np.where(known, area, np.nan)


class _Model(NamedTuple):
    """Weighted residuals, their slopes by the delay, the linear columns and their factors.

    The weight of a row, from 0 to 1, is Cauchy's.
    """

    rest: Floats
    by_delay: Floats
    linear: Floats
    factors: Floats
    weight: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Pairs of pictures, and the signal that they are fitted to."""

    start_s: Floats
    end_s: Floats
    seen: Floats
    integral: _Integral
    origin_ns: int
    event: Int64s | None

    def only(self, keep: Bools) -> _Fit:
        event = None if self.event is None else self.event[keep]
        kept = (self.start_s[keep], self.end_s[keep], self.seen[keep])
        return _Fit(*kept, self.integral, self.origin_ns, event)

    def known_for(self, reach_s: float, about_s: float = 0.0) -> Bools:
        """Return the pairs whose times are inside the signal for all delays searched."""
        known = np.ones(len(self.seen), np.bool_)
        for delay_s in (about_s - reach_s, about_s, about_s + reach_s):
            for edge_s in (self.start_s, self.end_s):
                known &= np.isfinite(self.integral.at(edge_s - delay_s, self.origin_ns)[0])
        return known

    def model(self, delay_s: float, drift: float) -> _Model:
        late = delay_s + drift * self.end_s
        end, at_end = self.integral.at(self.end_s - late, self.origin_ns)
        start, at_start = self.integral.at(self.start_s - late, self.origin_ns)
        good = np.isfinite(end) & np.isfinite(start)
        area = np.where(good, end - start, 0.0)
        by_delay = np.nan_to_num(at_start - at_end)
        if self.event is None:
            scale = np.ones((len(area), 1))
            linear = np.column_stack([area, self.end_s - self.start_s])
        else:
            mine = (self.event[:, None] == np.unique(self.event)).astype(np.float64)
            along = np.where(good, end, 0.0)[:, None]
            # Depths of the scene change as the car moves on.
            center = (mine * along).sum(axis=0) / np.maximum(mine.sum(axis=0), 1.0)
            scale = np.hstack([mine, mine * (along - center)])
            linear = scale * area[:, None]
        weight, noisy = good.astype(np.float64), np.ones(len(area))
        for _ in range(6):
            root = np.sqrt(weight)[:, None]
            factors = np.linalg.lstsq(linear * root, self.seen * root[:, 0], rcond=None)[0]
            rest = self.seen - linear @ factors
            if self.event is not None:
                noisy = np.hypot(GROWTH_SD, SCENE_SD * (linear @ factors))
            scaled = rest / noisy
            sd = max(1.4826 * float(np.median(np.abs(scaled[good]))), 1e-9)
            weight = good / noisy**2 / (1.0 + (scaled / (3.0 * sd)) ** 2)
        root = np.sqrt(weight)
        by_delay = by_delay * (scale @ factors[: scale.shape[1]])
        linear = linear * root[:, None]
        return _Model(rest * root, by_delay * root, linear, factors, weight * noisy**2)

    def slopes(self, model: _Model, *, has_drift: bool) -> Floats:
        """Return slopes by delay and drift, without what the linear part may explain."""
        slopes = np.column_stack([model.by_delay, model.by_delay * self.end_s])[:, : 1 + has_drift]
        hidden = np.linalg.lstsq(model.linear, slopes, rcond=None)[0]
        return np.asarray(slopes - model.linear @ hidden, np.float64)

    def prior(self, model: _Model, *, has_drift: bool) -> Floats:
        var = max(float((model.rest**2).mean()), 1e-30)
        return np.diag([0.0, var * DRIFT_SD**-2])[: 1 + has_drift, : 1 + has_drift]

    def solved(self, delay_s: float, *, has_drift: bool) -> tuple[float, float] | None:
        """Iterate Gauss and Newton's method from the best delay of the search."""
        drift = 0.0
        for _ in range(20):
            model = self.model(delay_s, drift)
            slopes, prior = self.slopes(model, has_drift=has_drift), None
            prior = self.prior(model, has_drift=has_drift)
            left = slopes.T @ slopes + prior
            if not left[0, 0] > 0.0 or not np.isfinite(left).all():
                return None
            right = slopes.T @ model.rest - prior @ np.array([0.0, drift])[: len(left)]
            change = np.linalg.lstsq(left, right, rcond=None)[0]
            delay_s += float(np.clip(change[0], -STEP_S, STEP_S))
            drift += float(change[1]) if has_drift else 0.0
            if abs(change[0]) < 1e-6:
                break
        return delay_s, drift

    def result(self, signal: str, delay_s: float, drift: float, *, has_drift: bool) -> CameraDelay:
        model = self.model(delay_s, drift)
        slopes = self.slopes(model, has_drift=has_drift)
        freedom = max(len(model.rest) - model.linear.shape[1] - slopes.shape[1], 1)
        var = float((model.rest**2).sum()) / freedom
        used, root = model.weight > 0.0, np.sqrt(model.weight)[:, None]
        # Outliers pull less than they should by their weights.
        bent = slopes.T @ (slopes * (2.0 * root**2 - 1.0))
        left = bent + self.prior(model, has_drift=has_drift)
        if not left[0, 0] > 0.0:
            return CameraDelay(signal)
        plain = np.hstack([slopes, model.linear])[used] / root[used]
        noise = _noise(self.end_s[used], (model.rest * root[:, 0])[used], plain, slopes.shape[1])
        inverse = np.linalg.pinv(left)
        sd = np.sqrt(np.diag(inverse @ noise @ inverse))
        is_turn = self.event is None
        return CameraDelay(
            signal,
            delay_s,
            float(np.hypot(sd[0], 0.0 if is_turn else STOP_SD_S)),
            drift * 1e6 if has_drift else None,
            float(sd[1]) * 1e6 if has_drift else None,
            len(model.rest),
            *(self.scale(model, var) if is_turn else ()),
        )

    def scale(self, model: _Model, var: float) -> tuple[float, float]:
        """Return the scale of a turn, and its s.d. with the delay free."""
        columns = np.column_stack([model.linear, model.by_delay])
        cov = var * np.linalg.pinv(columns.T @ columns)
        return float(model.factors[0]), float(np.sqrt(cov[0, 0]))


def _noise(t_s: Floats, rest: Floats, columns: Floats, slopes: int) -> Floats:
    """Return the covariance of the products of noise with the first columns.

    Args:
        t_s: Times of the residuals, ascending.
        rest: Residuals.
        columns: What was fitted, shape (N, C).
        slopes: Number of the first columns.
    """
    from scipy.linalg import cholesky_banded, orth, solveh_banded

    first, given = columns[:, :slopes], np.column_stack([orth(columns), rest])
    freedom = max(len(rest) - given.shape[1] + 1, 1)
    found, scores = [], []
    for scale_s in SCALES_S:
        kept = np.exp(-np.maximum(np.diff(t_s), 1e-6) / scale_s)
        # Inverse of the correlated part, which has three diagonals.
        ends = np.concatenate([[0.0], kept**2 / (1.0 - kept**2), [0.0]])
        beside = np.concatenate([[0.0], -kept / (1.0 - kept**2)])
        inverse = np.stack([beside, 1.0 + ends[1:] + ends[:-1]])
        correlated = first.T @ solveh_banded(inverse, first)
        for share in SHARES:
            # Of white and correlated noise: times ``inverse``, from the left.
            both = (1.0 - share) * inverse + [[0.0], [share]]
            normal = given.T @ solveh_banded(both, _tridiagonal(inverse, given))
            left, right = normal[:-1, :-1], normal[:-1, -1]
            square = max(float(normal[-1, -1] - right @ np.linalg.solve(left, right)), 1e-30)
            logs = 2.0 * np.log(cholesky_banded(both)[1]).sum() + np.log1p(-(kept**2)).sum()
            logs += np.linalg.slogdet(left)[1] + freedom * np.log(square)
            scores.append(-0.5 * logs)
            part = (1.0 - share) * first.T @ first + share * correlated
            found.append(square / max(freedom - 2, 1) * part)
    weights = np.exp(np.array(scores) - max(scores))
    return np.asarray(np.tensordot(weights / weights.sum(), found, 1), np.float64)


def _tridiagonal(bands: Floats, columns: Floats) -> Floats:
    """Return the product of a symmetric matrix, by its upper bands, with columns."""
    product: Floats = bands[1][:, None] * columns
    product[:-1] += bands[0, 1:, None] * columns[1:]
    product[1:] += bands[0, 1:, None] * columns[:-1]
    return product


def _fitted(
    signal: str, pairs: PictureMotion, seen: Floats, integral: _Integral, event: Int64s | None
) -> CameraDelay:
    """Fit delay and drift; scale and bias, or the scales of each standstill, are free."""
    if len(seen) < MIN_PAIRS or len(integral.t_ns) < MIN_PAIRS:
        return CameraDelay(signal)
    origin_ns = int(pairs.t_ns[len(seen) // 2])
    edges = np.stack([pairs.start_ns, pairs.t_ns])
    start_s, end_s = np.asarray((edges - origin_ns) * 1e-9, np.float64)
    fit = _Fit(start_s, end_s, seen, integral, origin_ns, event)
    reach_s = MAX_DELAY_S
    while (inside := fit.known_for(reach_s)).mean() < 0.6 and reach_s > 0.25:
        reach_s *= 0.5
    if inside.sum() < MIN_PAIRS:
        return CameraDelay(signal)
    searched = fit.only(inside)
    grid_s = np.arange(-reach_s, reach_s + 0.5 * STEP_S, STEP_S)
    costs = [float((searched.model(one, 0.0).rest ** 2).sum()) for one in grid_s.tolist()]
    best_s = float(grid_s[int(np.argmin(costs))])
    # Pairs near the ends of the signal are inside it for this delay, if not for all.
    fit = fit.only(fit.known_for(ENDS_S, best_s))
    has_drift = bool(fit.end_s[-1] - fit.start_s[0] >= DRIFT_FROM_S)
    found = fit.solved(best_s, has_drift=has_drift)
    if found is None or abs(found[0]) > reach_s or abs(found[0] - best_s) > ENDS_S:
        return CameraDelay(signal)
    return fit.result(signal, *found, has_drift=has_drift)
