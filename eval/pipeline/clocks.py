"""Which clock each topic is read by: chosen by a log's first seconds, judged over all of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from crosscue.eval.runs.manifest import ClockRow
from crosscue.replay.base import Log, Selection
from crosscue.replay.clocks.clock import Clock
from crosscue.replay.signals.extractor import Extractor

if TYPE_CHECKING:
    pass

PROBE_NS: Final = 10_000_000_000
"""Log time examined before a clock is chosen for each topic."""


def probe_clocks(log: Log, extractor: Extractor, selection: Selection) -> dict[str, Clock]:
    """Which clock to use for each planned topic, judged by the log's first seconds."""
    first_ns: int | None = None
    for block in log.read(extractor.ledger, selection):
        if not len(block):
            continue
        first_ns = int(block.log_ns[0]) if first_ns is None else first_ns
        for _ in extractor(block):
            pass
        if int(block.log_ns[0]) - first_ns > PROBE_NS:
            break
    return {name: report.used for name, report in extractor.watch.reports().items()}


def clock_rows(extractor: Extractor) -> dict[str, ClockRow]:
    """Clock used and the whole pass's report for each topic."""
    return {
        name: ClockRow(
            used=extractor.clocks.get(name, Clock.LOG),
            why=report.why,
            rows=report.of_used.rows,
            rate_hz=report.rate_hz,
        )
        for name, report in extractor.watch.reports().items()
    }


def clock_changes(extractors: Sequence[Extractor]) -> list[str]:
    """Topics whose clock would have been chosen otherwise in hindsight."""
    return [
        f"{name}: used the {extractor.clocks[name].value}, but over the whole log: {report.why}"
        for extractor in extractors
        for name, report in extractor.watch.reports().items()
        if name in extractor.clocks and extractor.clocks[name] is not report.used
    ]
