"""Tables of a Mobileye's decoded rows, written once with the run and read with any settings.

``mobileye_obstacles.parquet`` and ``mobileye_lanes.parquet`` hold the decoded rows in the rear
axle's frame (x ahead, y left), so that cues beyond the intersection need no log.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from crosscue.replay.signals.kinds import (
    LANE_COLUMNS,
    MOBILEYE_SIGNALS,
    OBSTACLE_COLUMNS,
    Samples,
    Signal,
)
from crosscue.replay.time.segments import BEGINNING, LogClock, Timeline
from crosscue.replay.vehicle.mobileye_cues import Past

from .labelled import LabelledSink
from .parquet import TableFolder

if TYPE_CHECKING:
    from crosscue.detectors.cues.far_side import MobileyeState
    from crosscue.fusion.evidence import PastCues
    from crosscue.fusion.intersection_range import RangeBelief

TABLES: Final[Mapping[Signal, tuple[str, tuple[str, ...]]]] = {
    Signal.MOBILEYE_OBSTACLES: ("mobileye_obstacles", OBSTACLE_COLUMNS),
    Signal.MOBILEYE_LANES: ("mobileye_lanes", LANE_COLUMNS),
}


class MobileyeSink(ExitStack):
    """Writer of both tables, a window at a time; a context manager."""

    def __init__(self, run: TableFolder, timeline: Timeline, clock: LogClock) -> None:
        super().__init__()
        self._sinks: Final = {
            signal: self.enter_context(LabelledSink(run, name, timeline, clock))
            for signal, (name, _) in TABLES.items()
        }

    def write(self, samples: Mapping[Signal, Samples]) -> None:
        """Append the device's samples of a window."""
        for signal in MOBILEYE_SIGNALS:
            found = samples.get(signal)
            if found is not None and len(found.t_ns):
                columns = dict(zip(TABLES[signal][1], found.values.T, strict=True))
                self._sinks[signal].write({"t_ns": found.t_ns, **columns})


class StoredMobileye:
    """Reader of both tables, forward in time; memory holds a batch of each."""

    def __init__(self, run: TableFolder, past: Past) -> None:
        self._past: Final = past
        self._since_ns = BEGINNING
        self._readers: Final = {signal: _Reader(signal, _parts(run, signal)) for signal in TABLES}

    def at(self, t_ns: int) -> MobileyeState:
        """Return the device's state at ``t_ns``; call it with times that do not decrease."""
        from crosscue.detectors.cues.far_side import state_at  # ``MobileyeSink`` needs no cues

        keep_ns = round((self._past.max_age_s + 1.0) * 1e9)
        obstacles, lanes = (
            self._readers[signal].around(t_ns, keep_ns) for signal in MOBILEYE_SIGNALS
        )
        return state_at(self._fresh(obstacles), self._fresh(lanes), t_ns, self._past)

    def forget_before(self, t_ns: int) -> None:
        """Ignore everything reported before ``t_ns``."""
        self._since_ns = t_ns

    def _fresh(self, held: Samples | None) -> Samples | None:
        if held is None or held.t_ns[0] >= self._since_ns:
            return held
        return held.take(held.t_ns >= self._since_ns)

    def cues(self, t_ns: int) -> PastCues:
        """Return the cues beyond the intersection at ``t_ns``, evaluated once a range is known."""
        from crosscue.detectors.cues.far_side import end_of, past_counts
        from crosscue.fusion.intersection_range import Reference

        past = self._past

        def counts(best: RangeBelief | None, reference: Reference | None) -> Mapping[str, int]:
            if best is None:
                return {}
            end_m = end_of(best.mean_m, is_end=reference is Reference.END, past=past)
            return past_counts(self.at(t_ns), end_m, past)

        return counts


@dataclass(slots=True)
class _Reader:
    signal: Signal
    parts: Iterator[Samples]
    held: Samples | None = None

    def around(self, t_ns: int, keep_ns: int) -> Samples | None:
        """Return samples from ``keep_ns`` before ``t_ns``, or earlier, to after it."""
        while self.held is None or self.held.t_ns[-1] <= t_ns:
            fresh = next(self.parts, None)
            if fresh is None:
                break
            self.held = fresh if self.held is None else _joined(self.held, fresh, t_ns - keep_ns)
        return self.held


def _joined(before: Samples, fresh: Samples, from_ns: int) -> Samples:
    rest = before.take(before.t_ns >= from_ns)
    return Samples(
        fresh.signal,
        np.concatenate([rest.t_ns, fresh.t_ns]),
        np.concatenate([rest.values, fresh.values]),
    )


def _parts(run: TableFolder, signal: Signal) -> Iterator[Samples]:
    name, columns = TABLES[signal]
    if not run.file(f"{name}.parquet").exists():
        return
    for batch in run.batches(name):
        values: list[Any] = [batch[column].to_numpy(zero_copy_only=False) for column in columns]
        yield Samples(signal, batch["t_ns"].to_numpy(), np.stack(values, axis=1))
