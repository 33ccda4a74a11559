"""Clocks of topics: chosen from a log's first seconds, and judged over the complete log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from crosscue.eval.runs.manifest import ClockRow
from crosscue.replay.clocks.clock import Clock
from crosscue.replay.clocks.reports import ClockReport


def clock_rows(
    used: Mapping[str, Clock], reports: Mapping[str, ClockReport]
) -> dict[str, ClockRow]:
    """Return the clock used and the report over the complete log, by topic."""
    return {
        name: ClockRow(
            used=used.get(name, Clock.LOG),
            why=report.why,
            rows=report.of_used.rows,
            rate_hz=report.rate_hz,
        )
        for name, report in reports.items()
    }


def clock_changes(used: Mapping[str, Clock], reports: Mapping[str, ClockReport]) -> Iterator[str]:
    """Yield notices of topics for which the complete log suggests another clock."""
    for name, report in reports.items():
        if name in used and used[name] is not report.used:
            yield f"{name}: used the {used[name].value}, but over the whole log: {report.why}"
