"""What a Mobileye has said lately, as it was known at a time: no look at what came later."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from crosscue.replay.columns import Floats
from crosscue.replay.signals.kinds import LANE_COLUMNS, OBSTACLE_COLUMNS, Samples
from crosscue.replay.vehicle.mobileye_cues import Past

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
    oldest = t_ns - round(past.max_age_s * 1e9)
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
