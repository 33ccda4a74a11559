"""What a Mobileye has said lately, as it was known at a time: no look at what came later."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from crosscue.replay.columns import Floats
from crosscue.replay.mobileye.samples import LANE_COLUMNS, OBSTACLE_COLUMNS
from crosscue.replay.past_settings import Past
from crosscue.replay.signals import MOBILEYE_SIGNALS, Samples, Signal

_BURST, _X = OBSTACLE_COLUMNS.index("burst"), OBSTACLE_COLUMNS.index("x_m")
_SIDE = LANE_COLUMNS.index("side")


@dataclass(frozen=True, slots=True, eq=False)
class MobileyeState:
    """The last whole burst and the last line of each side.

    Attributes:
        obstacles: Shape (N, 8), ``OBSTACLE_COLUMNS``; no rows where it saw none, None where it has
            not spoken lately.
        lanes: Shape (M, 8), ``LANE_COLUMNS``; likewise.
    """

    obstacles: Floats | None
    lanes: Floats | None


def state_at(
    obstacles: Samples | None, lanes: Samples | None, t_ns: int, past: Past
) -> MobileyeState:
    """What was known at ``t_ns``: bursts that were whole by then, and not too old.

    Args:
        obstacles: Rows of ``Signal.MOBILEYE_OBSTACLES``, in order of time.
        lanes: Rows of ``Signal.MOBILEYE_LANES``, likewise.
        t_ns: Log time.
        past: How long a burst takes, and when it is too old.
    """
    newest = t_ns - round(past.settles_s * 1e9)
    oldest = t_ns - round(past.most_age_s * 1e9)
    return MobileyeState(
        _last_burst(_between(obstacles, oldest, newest), past),
        _last_lanes(_between(lanes, oldest, newest)),
    )


def _between(samples: Samples | None, oldest_ns: int, newest_ns: int) -> Samples | None:
    if samples is None:
        return None
    low = int(np.searchsorted(samples.t_ns, oldest_ns, side="left"))
    high = int(np.searchsorted(samples.t_ns, newest_ns, side="right"))
    if low >= high:
        return None
    return Samples(samples.signal, samples.t_ns[low:high], samples.values[low:high])


def _last_burst(samples: Samples | None, past: Past) -> Floats | None:
    if samples is None:
        return None
    values = samples.values
    last = values[:, _BURST] == values[-1, _BURST]
    if values[-1, _BURST] < 0:
        # Messages without a status message: those of one image come together.
        last = samples.t_ns > samples.t_ns[-1] - round(past.settles_s * 1e9)
    found: Floats = values[last & np.isfinite(values[:, _X])]
    return found


def _last_lanes(samples: Samples | None) -> Floats | None:
    if samples is None:
        return None
    sides = samples.values[:, _SIDE]
    rows = [int(np.flatnonzero(sides == side)[-1]) for side in np.unique(sides)]
    found: Floats = samples.values[rows]
    return found


@dataclass(slots=True)
class MobileyeMemory:
    """Samples as they come, window by window, as far back as they may matter."""

    past: Past
    _kept: dict[Signal, Samples] = field(default_factory=dict)

    def add(self, samples: Mapping[Signal, Samples]) -> None:
        """Take in a window's samples; those of other signals are left alone."""
        for signal in MOBILEYE_SIGNALS:
            fresh = samples.get(signal)
            if fresh is None or not len(fresh.t_ns):
                continue
            before = self._kept.get(signal)
            if before is not None:
                t_ns = np.concatenate([before.t_ns, fresh.t_ns])
                fresh = Samples(signal, t_ns, np.concatenate([before.values, fresh.values]))
            # A window may be asked about from its start, so what mattered then is kept.
            keep_ns = round((self.past.most_age_s + 2.0) * 1e9)
            self._kept[signal] = fresh.take(fresh.t_ns >= fresh.t_ns[-1] - keep_ns)

    def at(self, t_ns: int) -> MobileyeState:
        """What was known at ``t_ns``, which may lie up to 2 s before the last sample."""
        return state_at(
            self._kept.get(Signal.MOBILEYE_OBSTACLES),
            self._kept.get(Signal.MOBILEYE_LANES),
            t_ns,
            self.past,
        )
