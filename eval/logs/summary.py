"""Summaries of drives, printed by ``crosscue info``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final

from crosscue.eval.pipeline.drive_time import (
    may_have_wheels,
    plan_for_time,
    time_segments,
    without_wheels,
)
from crosscue.eval.runs.drive import Drive
from crosscue.replay.base import Log, Selection
from crosscue.replay.clocks.findings import instant_text
from crosscue.replay.logs.log_summary import (
    LogSummary,
    Together,
    TopicSummary,
    common_span,
    quick_summary,
    rows_of_clocks,
    span_sentence,
    summarise_log,
)
from crosscue.replay.safe_text import counted, table, terminal_width, wrapped
from crosscue.replay.time.scan import DriveWatch
from crosscue.replay.time.segments import SplitLimits, Timeline, gaps_text
from crosscue.results import HIDDEN, Result

from .log import DriveGiven, opened

if TYPE_CHECKING:
    from crosscue.replay.vehicle.vehicle import Vehicle

LOSSES_SHOWN: Final = 10


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class DriveSummary(Result):
    """Topics, counts, rates, gaps, clocks and account of a drive's logs.

    Attributes:
        logs: One summary per log.
        together: Comparison of the logs; None for a single log or a quick summary.
        timeline: Time segments of the drive; None for a quick summary.
        camera_delay_s: Delay of the pictures' stamps that the vehicle file states.
    """

    logs: tuple[LogSummary, ...]
    together: Together | None
    timeline: Timeline | None = field(default=None, metadata=HIDDEN)
    camera_delay_s: float = 0.0

    also: ClassVar = {"time": "time"}

    @property
    def has_gaps(self) -> bool:
        """True if the drive has several segments, because of a gap or a clock that was set."""
        return self.timeline is not None and self.timeline.has_gaps

    @property
    def is_whole(self) -> bool:
        """True if no row is known to be dropped."""
        return all(one.is_whole for one in self.logs)

    @property
    def exit_status(self) -> int:
        """0 when all logs are complete, 3 when something is dropped or the drive has segments."""
        return 0 if self.is_whole and not self.has_gaps else 3

    @property
    def time(self) -> object:
        """Time segments, as in the manifest of a run."""
        return None if self.timeline is None else time_segments(self.timeline).as_json()

    def lines(self) -> Iterator[str]:
        """Yield tables of topics, clocks and accounts of each log."""
        width = terminal_width()
        for one in self.logs:
            yield from lines_of(one, width)
        if self.together is not None:
            yield from _lines_together(self.together, width)
        if self.timeline is not None and self.has_gaps:
            yield from _segments(self.timeline, width)
        if self.camera_delay_s:
            yield f"pictures   stamped {self.camera_delay_s * 1e3:+.0f} ms late (camera.delay_s)"


def info(
    log: DriveGiven, vehicle: Vehicle | Path | str | None = None, *, quick: bool = False
) -> DriveSummary:
    """List topics, counts, clocks, gaps and damage of a log.

    Offset and drift compare the header stamp, or else the publish time, with the log time.

    Examples:
        crosscue info drive.mcap
        crosscue info drive.mcap can0.log --json > drive.json
        crosscue info --quick drive.bag      only read what the file declares about itself
        crosscue info https://host/drive.mcap --from 60 --to 62

    Args:
        log: The drive.
        vehicle: Vehicle file: topic of wheel speeds, to find gaps, and delay of the pictures.
        quick: Print what the log declares, and whether its end is missing, without reading its
            messages.
    """
    settings = None if vehicle is None else _settings(vehicle)
    with opened(log) as drive:
        if quick:
            return DriveSummary(tuple(map(quick_summary, drive.logs)), None)
        return summary_of(drive.logs, drive.selection, settings)


def _settings(given: Vehicle | Path | str | None) -> Vehicle:
    # A vehicle file takes longer to import than a small log to read.
    from crosscue.replay.vehicle.vehicle import vehicle_given

    return vehicle_given(given)


def summary_of(logs: Sequence[Log], selection: Selection, vehicle: Vehicle | None) -> DriveSummary:
    """Summarise logs, by reading each once.

    Args:
        logs: Open logs of one drive.
        selection: The part to read.
        vehicle: Vehicle file with the topic of wheel speeds, to find gaps; None for the defaults.
    """
    if vehicle is None and may_have_wheels(logs):
        vehicle = _settings(None)
    limits = SplitLimits() if vehicle is None else vehicle.time.split
    planned, wheels = (
        without_wheels(logs) if vehicle is None else plan_for_time(Drive(logs, vehicle, selection))
    )
    watch = DriveWatch(planned, limits, wheels)
    found = tuple(
        summarise_log(log, selection, one.add) for log, one in zip(logs, watch.logs, strict=True)
    )
    together = common_span(found) if len(found) > 1 else None
    delay_s = 0.0 if vehicle is None else vehicle.camera.delay_s
    return DriveSummary(found, together, watch.timeline(), delay_s)


def lines_of(summary: LogSummary, width: int) -> Iterator[str]:
    """Yield a summary as lines of text, no wider than ``width`` unless numbers need more."""
    yield wrapped(f"{summary.path} ({summary.format})", width, "")
    if not summary.is_quick:
        yield wrapped(span_sentence(summary.start_ns, summary.end_ns), width, "  time       ")
        yield wrapped(summary.integrity, width, "  integrity  ")
    yield wrapped(summary.seal, width, "  seal       ")
    yield ""
    yield from _topics(summary, width)
    if not summary.is_quick:
        yield from _clocks(summary, width)
        yield from _account(summary, width)
        yield from _can_ids(summary, width)
    yield from _bullets("findings", summary.findings, width)
    yield from _bullets("notices", summary.notices, width)
    yield from _losses(summary, width)


def _topics(summary: LogSummary, width: int) -> Iterator[str]:
    counted = "declared" if summary.is_quick else "count"
    rows = [
        (
            t.name,
            t.type_name,
            t.used_as or "-",
            _or_dash(t.declared if summary.is_quick else t.used),
            "-" if t.rate_hz is None else f"{t.rate_hz:.4g}",
        )
        for t in summary.topics
    ]
    head = ("topic", "type", "used as", counted, "rate Hz")
    n = 4 if summary.is_quick else 5
    yield from table(head[:n], [row[:n] for row in rows], width, (0, 1, 2))
    yield ""


def _clocks(summary: LogSummary, width: int) -> Iterator[str]:
    rows = list(rows_of_clocks(summary.topics))
    if rows:
        head = ("topic", "clock", "period", "gaps", "longest", "offset", "drift ppm")
        yield from table(head, rows, width, (0, 1))
        yield ""


def _account(summary: LogSummary, width: int) -> Iterator[str]:
    rows = [
        (
            t.name,
            _or_dash(t.declared),
            str(t.found),
            str(t.used),
            str(sum(t.skipped.values())),
            ">= " * bool(t.dropped_unknown) + str(sum(t.dropped.values())),
        )
        for t in summary.topics
    ]
    if summary.unattributed_dropped or summary.unattributed_unknown:
        unknown = ">= " * bool(summary.unattributed_unknown)
        dropped = f"{unknown}{sum(summary.unattributed_dropped.values())}"
        rows.append(("(topic not known)", "-", "-", "-", "-", dropped))
    yield from table(
        ("topic", "declared", "found", "used", "skipped", "dropped"), rows, width, (0,)
    )
    for topic in summary.topics:
        for reason, count in sorted(topic.skipped.items()):
            yield wrapped(f"{topic.name}: {count} skipped: {reason}", width, "  ")
    yield ""


def _can_ids(summary: LogSummary, width: int) -> Iterator[str]:
    buses = [topic for topic in summary.topics if topic.can_ids]
    for bus in buses:
        yield wrapped(f"{bus.name}: {_ids_in_words(bus)}", width, "")
    if buses:
        yield ""


def _ids_in_words(bus: TopicSummary) -> str:
    named = ", ".join(
        f"0x{i.arbitration_id:X}{'x' * i.is_extended}"
        + (f" {i.rate_hz:.3g} Hz" if i.rate_hz else f" {counted(i.count, 'time')}")
        for i in bus.can_ids
    )
    prefix = "most frequent: " if bus.can_id_count > len(bus.can_ids) else ""
    return f"{counted(bus.can_id_count, 'id')}; {prefix}{named}"


def _losses(summary: LogSummary, width: int) -> Iterator[str]:
    texts = []
    for loss in summary.drops[:LOSSES_SHOWN]:
        count = "an unknown number" if loss.count is None else str(loss.count)
        begin_ns = summary.start_ns or 0
        at = "" if loss.t_ns is None else f" at {(loss.t_ns - begin_ns) * 1e-9:.2f} s"
        detail = f" ({loss.detail})" if loss.detail else ""
        texts.append(f"{count} of {loss.topic or 'unknown topics'}{at}: {loss.reason}{detail}")
    if len(summary.drops) > LOSSES_SHOWN:
        texts.append(f"and {len(summary.drops) - LOSSES_SHOWN} more; --json lists them")
    if summary.drops:
        texts.append("to write the readable part: crosscue convert LOG -o OUT.mcap --salvage")
    yield from _bullets("losses", texts, width)


def _lines_together(common: Together, width: int) -> Iterator[str]:
    if common.start_ns is None:
        yield wrapped("no time in common", width, "together   ")
    else:
        yield wrapped(span_sentence(common.start_ns, common.end_ns), width, "together   ")
    yield from (wrapped(sentence, width) for sentence in common.findings)


def _segments(timeline: Timeline, width: int) -> Iterator[str]:
    rows = [
        (
            str(one.number),
            one.cause.value,
            "-" if one.gap_ns is None else f"{one.gap_ns * 1e-9:.2f}",
            f"{one.by_ns * 1e-9:.2f}" if one.by_ns else "-",
            instant_text(one.log_start_ns),
            f"{(one.log_end_ns - one.log_start_ns) * 1e-9:.2f}",
        )
        for one in timeline.segments
    ]
    head = ("segment", "begins with", "gap s", "clock set s", "from", "length s")
    yield from table(head, rows, width, (1, 4))
    yield from (wrapped(sentence, width) for sentence in gaps_text(timeline.segments))


def _bullets(title: str, sentences: Iterable[str], width: int) -> Iterator[str]:
    lines = [wrapped(sentence, width) for sentence in sentences]
    if lines:
        yield from (title, *lines, "")


def _or_dash(count: int | None) -> str:
    return "-" if count is None else str(count)
