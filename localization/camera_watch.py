"""Watch of a camera's mounting over a drive: pitch, yaw and height, every ten seconds.

Pitch and yaw are the direction of travel in the pictures of a straight road. The height is the
speed by the car's own sensors over the speed by the ground in the pictures, which is in proportion
to the height that was assumed. A step is found by comparing what was measured before a moment with
what was measured after it; both have intervals from the variation of successive measurements.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

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
# Successive measurements that share an error.
CORRELATED: Final = 4


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
    mean, sd = _mean(value, measured)
    sd = math.hypot(sd, SAME_SD[value] * (abs(mean) if value == "height" else 1.0))
    return MountingWindow(value, int(t_ns[0]), int(t_ns[-1]), mean, sd, len(measured))


def steps_of(value: str, t_ns: Int64s, measured: Floats) -> list[MountingStep]:
    """Return the steps of a value, the most significant of neighbouring moments each.

    Args:
        value: Name of the value.
        t_ns: Times, ascending.
        measured: Measurements; NaN where unknown.
    """
    t_ns, measured = _known(t_ns, measured)
    found: list[MountingStep] = []
    for at in range(MIN_MEASURED, len(t_ns) - MIN_MEASURED + 1):
        before = measured[:at][t_ns[at] - t_ns[:at] <= BESIDE_NS]
        after = measured[at:][t_ns[at:] - t_ns[at] <= BESIDE_NS]
        if min(len(before), len(after)) < MIN_MEASURED:
            continue
        (old, old_sd), (new, new_sd) = _mean(value, before), _mean(value, after)
        least = LEAST_STEP[value] * (abs(old) if value == "height" else 1.0)
        step = MountingStep(value, int(t_ns[at]), new - old, math.hypot(old_sd, new_sd))
        if abs(step.by) > max(SIGMAS * step.sd, least):
            found.append(step)
    return _strongest(found)


def _strongest(steps: Sequence[MountingStep]) -> list[MountingStep]:
    kept: list[MountingStep] = []
    for step in sorted(steps, key=lambda one: -abs(one.by) / one.sd):
        if all(abs(step.t_ns - other.t_ns) > BESIDE_NS for other in kept):
            kept.append(step)
    return sorted(kept, key=lambda one: one.t_ns)


def _mean(value: str, measured: Floats) -> tuple[float, float]:
    """Return the median, and the s.d. of it with what the road explains."""
    middle = float(np.median(measured))
    spread = 1.4826 * float(np.median(np.abs(measured - middle)))
    sd = 1.2533 * spread * math.sqrt(CORRELATED / len(measured))
    road = ROAD_SD[value] * (abs(middle) if value == "height" else 1.0)
    return middle, math.hypot(sd, road)
