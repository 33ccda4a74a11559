"""Merge the signals of several logs by time, and cut them into windows.

Memory is bounded by the horizon, not by the length of the logs. A window closes once every source
has passed its end, or the source's log is ahead of it by the horizon. Later rows are skipped and
reported.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np

from crosscue.replay.base import Readable, Selection
from crosscue.replay.columns import Block
from crosscue.replay.ledger import Ledger
from crosscue.replay.signals.kinds import Samples, Signal, SignalPlan

WIDTH_NS: Final = 1_000_000_000
HORIZON_NS: Final = 60_000_000_000
# Max disorder of the rows of one topic, or lag of their own clock, before they count as late.
SLACK_NS: Final = 1_200_000_000


@dataclass(frozen=True, slots=True)
class SampleWindow:
    """All samples with ``start_ns <= t < end_ns``, each signal in order of time."""

    start_ns: int
    end_ns: int
    samples: Mapping[Signal, Samples]


class Extracting(Protocol):
    """Extractor of samples from a log's blocks, see ``signals.extractor.SampleExtractor``."""

    @property
    def ledger(self) -> Ledger:
        """Ledger that records skipped rows."""

    def __call__(self, block: Block) -> Iterator[Samples]:
        """Yield the samples of one block."""

    def finish(self) -> Iterator[tuple[str, Samples]]:
        """Yield the samples held back until the log's end, with their topics."""


@dataclass(slots=True)
class _Progress:
    """Reading position of one log."""

    log_ns: int | None = None
    topic_ns: dict[str, int] = field(default_factory=dict)
    ended: bool = False

    def saw(self, block: Block) -> None:
        first, last = int(block.log_ns.min()), int(block.log_ns.max())
        self.log_ns = first if self.log_ns is None else max(self.log_ns, first)
        self.topic_ns[block.topic] = max(self.topic_ns.get(block.topic, last), last)

    def passed(self, end_ns: int, topics: frozenset[str]) -> bool:
        if self.ended:
            return True
        if self.log_ns is None:
            return False
        if self.log_ns >= end_ns + HORIZON_NS:
            return True
        return all(self.topic_ns.get(topic, end_ns) >= end_ns + SLACK_NS for topic in topics) and (
            self.topic_ns.keys() >= topics or self.log_ns >= end_ns + HORIZON_NS
        )


def windows(
    logs: Sequence[Readable],
    extractors: Sequence[Extracting],
    selections: Sequence[Selection],
    planned: SignalPlan,
    width_ns: int = WIDTH_NS,
) -> Iterator[SampleWindow]:
    """Read all logs in parallel, and yield their signals in windows; empty windows are omitted.

    Args:
        logs: Open logs of one drive.
        extractors: One extractor for each log, with the log's ledger.
        selections: Selection to read of each log.
        planned: Plan of topics and signals.
        width_ns: Length of a window.
    """
    streams = [
        e.ledger.handing_on(log.read(e.ledger, s))
        for log, e, s in zip(logs, extractors, selections, strict=True)
    ]
    topics = [planned.topics_of(i) for i in range(len(logs))]
    progress = [_Progress() for _ in logs]
    pending = _Pending([e.ledger for e in extractors], width_ns)
    while not all(p.ended for p in progress):
        # The log that lags behind is read next, so that no log has to be held in memory.
        behind = min(
            (i for i, p in enumerate(progress) if not p.ended),
            key=lambda i: (progress[i].log_ns is not None, progress[i].log_ns or 0),
        )
        block = next(streams[behind], None)
        if block is None:
            progress[behind].ended = True
            for topic, samples in extractors[behind].finish():
                pending.add(behind, topic, samples)
        elif len(block):
            progress[behind].saw(block)
            for samples in extractors[behind](block):
                pending.add(behind, block.topic, samples)
        while (end_ns := pending.next_end()) is not None and all(
            p.passed(end_ns, t) for p, t in zip(progress, topics, strict=True)
        ):
            yield pending.close(end_ns)


class _Pending:
    """Samples of windows that are still open."""

    def __init__(self, ledgers: Sequence[Ledger], width_ns: int) -> None:
        self._ledgers: Final = ledgers
        self._width_ns: Final = width_ns
        self._parts: dict[Signal, list[Samples]] = {}
        self._closed_ns: int | None = None

    def add(self, log: int, topic: str, samples: Samples) -> None:
        """Add samples; those before the last closed window's end are reported as late."""
        if not len(samples.t_ns):
            return
        if self._closed_ns is not None:
            late = samples.t_ns < self._closed_ns
            if late.any():
                self._ledgers[log].skip(
                    topic,
                    "too late to be put in order",
                    int(late.sum()),
                    f"before {self._closed_ns} ns",
                    int(samples.t_ns[late][0]),
                )
                samples = samples.take(~late)
        if len(samples.t_ns):
            self._parts.setdefault(samples.signal, []).append(samples)

    def next_end(self) -> int | None:
        """Return the end of the earliest window with samples."""
        firsts = [int(part.t_ns.min()) for parts in self._parts.values() for part in parts]
        return (min(firsts) // self._width_ns + 1) * self._width_ns if firsts else None

    def close(self, end_ns: int) -> SampleWindow:
        """Remove and return the window that ends at ``end_ns``."""
        samples: dict[Signal, Samples] = {}
        for signal in Signal:
            inside: list[Samples] = []
            outside: list[Samples] = []
            for part in self._parts.pop(signal, []):
                early = part.t_ns < end_ns
                inside.append(part.take(early))
                if not early.all():
                    outside.append(part.take(~early))
            if outside:
                self._parts[signal] = outside
            t_ns = (
                np.concatenate([part.t_ns for part in inside]) if inside else np.empty(0, np.int64)
            )
            if len(t_ns):
                order = np.argsort(t_ns, kind="stable")
                values = np.concatenate([part.values for part in inside])
                samples[signal] = Samples(signal, t_ns[order], values[order])
        self._closed_ns = end_ns
        return SampleWindow(end_ns - self._width_ns, end_ns, samples)
