"""Watch of a camera's mounting over a drive: pitch, yaw and height, every ten seconds.

Pitch and yaw are the direction of travel in the pictures of a straight road. The height is the
speed by the car's own sensors over the speed by the ground in the pictures, which is in proportion
to the height that was assumed. A step is fitted to what was measured before and after a moment,
together with what the car's signals explain, such as a nod. Intervals follow from the residuals and
their correlation, which is that of this drive (long-run variance; Newey and West, Econometrica 55,
1987).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from crosscue.replay.columns import Floats, Int64s

WINDOW_NS: Final = 10_000_000_000
# Min number of measurements in a window, and on each side of a step.
MIN_MEASURED: Final = 8
# Measurements on each side of a step, at most this old.
BESIDE_NS: Final = 8_000_000_000
# A step is reported above this many standard deviations and above the least step of each value.
SIGMAS: Final = 4.0
# S.d. of a mean over seconds that slopes, loads and textures of the road explain.
ROAD_SD: Final = {"pitch": math.radians(0.05), "yaw": math.radians(0.05), "height": 0.02}
# S.d. of an error that stays the same over a drive, such as that of the optical center: it widens
# values, not steps. On two real drives the angles are off by up to 0.2 degrees.
SAME_SD: Final = {"pitch": math.radians(0.12), "yaw": math.radians(0.12), "height": 0.02}
LEAST_STEP: Final = {"pitch": math.radians(0.25), "yaw": math.radians(0.25), "height": 0.1}
# Successive measurements that may share an error, and s.d. of the residuals beyond which a
# measurement counts less.
CORRELATED: Final = 8
FAR: Final = 2.0
FITS: Final = 6
LEAST_SCALE: Final = 1e-9


@dataclass(frozen=True, slots=True)
class MountingWindow:
    """One value of the mounting in some seconds of a drive.

    Attributes:
        value: ``pitch``, ``yaw`` (radians) or ``height`` (metres).
        start_ns: First time.
        end_ns: Last time.
        mean: Robust mean.
        sd: Its standard deviation.
        measured: Number of measurements.
    """

    value: str
    start_ns: int
    end_ns: int
    mean: float
    sd: float
    measured: int

    def __str__(self) -> str:
        if self.value == "height":
            return f"{self.mean:.2f} +- {1.96 * self.sd:.2f} m"
        return f"{math.degrees(self.mean):+.2f} +- {math.degrees(1.96 * self.sd):.2f} deg"


@dataclass(frozen=True, slots=True)
class MountingStep:
    """A step of one value.

    Attributes:
        value: As in ``MountingWindow``.
        t_ns: Time of the step.
        by: Size of the step.
        sd: Its standard deviation.
    """

    value: str
    t_ns: int
    by: float
    sd: float

    def __str__(self) -> str:
        if self.value == "height":
            return f"height changed by {self.by:+.2f} +- {1.96 * self.sd:.2f} m"
        by, sd = math.degrees(self.by), math.degrees(1.96 * self.sd)
        return f"{self.value} changed by {by:+.2f} +- {sd:.2f} deg"


def windows_of(value: str, t_ns: Int64s, measured: Floats) -> list[MountingWindow]:
    """Return the mean of every ten seconds with enough measurements.

    Args:
        value: Name of the value.
        t_ns: Times, ascending.
        measured: Measurements; NaN where unknown.
    """
    t_ns, measured = _known(t_ns, measured)
    if not len(t_ns):
        return []
    number = (t_ns - t_ns[0]) // WINDOW_NS
    found = []
    for one in np.unique(number).tolist():
        mine = number == one
        if mine.sum() >= MIN_MEASURED:
            found.append(_window(value, t_ns[mine], measured[mine]))
    return found


def whole(value: str, t_ns: Int64s, measured: Floats) -> MountingWindow | None:
    """Return the mean of all measurements; None with too few."""
    t_ns, measured = _known(t_ns, measured)
    return _window(value, t_ns, measured) if len(t_ns) >= MIN_MEASURED else None


def _known(t_ns: Int64s, measured: Floats) -> tuple[Int64s, Floats]:
    is_known = np.isfinite(measured)
    return t_ns[is_known], measured[is_known]


def _window(value: str, t_ns: Int64s, measured: Floats) -> MountingWindow:
    fit = _fitted(np.ones((len(t_ns), 1)), measured, np.empty((len(t_ns), 0)))
    mean = float(fit.found[0])
    size = abs(mean) if value == "height" else 1.0
    sd = math.hypot(fit.sd[0], ROAD_SD[value] * size, SAME_SD[value] * size)
    return MountingWindow(value, int(t_ns[0]), int(t_ns[-1]), mean, sd, len(measured))


def steps_of(
    value: str, t_ns: Int64s, measured: Floats, explained: Floats | None = None
) -> list[MountingStep]:
    """Return the steps of a value, the likeliest of neighbouring moments each.

    Args:
        value: Name of the value.
        t_ns: Times, ascending.
        measured: Measurements; NaN where unknown.
        explained: What the car's signals explain of them, up to a factor of about 1; NaN where
            unknown.
    """
    signals = np.zeros((len(t_ns), 0)) if explained is None else explained[:, None]
    is_known = np.isfinite(measured) & np.isfinite(signals).all(axis=1)
    t_ns, measured, signals = t_ns[is_known], measured[is_known], signals[is_known]
    found: list[tuple[float, MountingStep]] = []
    for at in range(MIN_MEASURED, len(t_ns) - MIN_MEASURED + 1):
        near = np.abs(t_ns - t_ns[at]) <= BESIDE_NS
        is_after = np.arange(len(t_ns))[near] >= at
        if min(is_after.sum(), (~is_after).sum()) < MIN_MEASURED:
            continue
        same = np.ones((len(is_after), 1))
        fit = _fitted(np.column_stack([same, is_after]), measured[near], signals[near])
        size = abs(fit.found[0]) if value == "height" else 1.0
        by, sd = float(fit.found[1]), math.hypot(fit.sd[1], 2.0**0.5 * ROAD_SD[value] * size)
        if abs(by) > max(SIGMAS * sd, LEAST_STEP[value] * size):
            without = _fitted(same, measured[near], signals[near])
            likelihood = len(same) * math.log(without.loss(fit.scale) / fit.loss(fit.scale))
            found.append((likelihood, MountingStep(value, int(t_ns[at]), by, sd)))
    kept: list[MountingStep] = []
    for _, step in sorted(found, key=lambda one: -one[0]):
        if all(abs(step.t_ns - other.t_ns) > BESIDE_NS for other in kept):
            kept.append(step)
    return sorted(kept, key=lambda one: one.t_ns)


def without_explained(
    t_ns: Int64s, measured: Floats, explained: Floats, steps: Sequence[MountingStep]
) -> Floats:
    """Return measurements less what signals explain of them; NaN where either is unknown."""
    is_known = np.isfinite(measured) & np.isfinite(explained)
    free = np.column_stack([np.ones(len(t_ns)), *(t_ns >= one.t_ns for one in steps)])
    fit = _fitted(free[is_known], measured[is_known], explained[is_known, None])
    return np.asarray(measured - fit.found[-1] * explained)


class _Fit(NamedTuple):
    """Factors of columns, their s.d., the residuals, and the residuals' scale."""

    found: Floats
    sd: Floats
    rest: Floats
    scale: float

    def loss(self, scale: float) -> float:
        """Return the sum of squares, each limited in proportion to a scale."""
        return float(np.minimum(self.rest**2, (3.0 * FAR * scale) ** 2).sum()) + scale**2


def _fitted(free: Floats, measured: Floats, signals: Floats) -> _Fit:
    """Fit columns, reweighted after Huber; factors of ``signals`` have an s.d. of 1 before."""
    design = np.column_stack([free, signals])
    prior = np.diag([0.0] * free.shape[1] + [1.0] * signals.shape[1])
    weight, scale = np.ones(len(measured)), max(float(np.std(measured)), LEAST_SCALE)
    for _ in range(FITS):
        information = (design * weight[:, None]).T @ design
        found = np.linalg.solve(
            information + scale**2 * prior, (design * weight[:, None]).T @ measured
        )
        rest = measured - design @ found
        scale = max(1.4826 * float(np.median(np.abs(rest))), LEAST_SCALE)
        weight = np.minimum(FAR * scale / np.maximum(np.abs(rest), 1e-12), 1.0)
    near = np.clip(rest, -FAR * scale, FAR * scale)
    variance = float(near @ near)
    lags = min(CORRELATED, len(near) // 4)
    shared = sum(
        (1.0 - lag / (lags + 1)) * (near[lag:] @ near[:-lag]) for lag in range(1, lags + 1)
    )
    variance = max(variance + 2.0 * float(shared), variance, scale**2)
    variance /= max(len(near) - design.shape[1], 1)
    spread = variance * np.linalg.inv(information + variance * prior)
    return _Fit(np.asarray(found, np.float64), np.sqrt(np.diag(spread)), rest, scale)
