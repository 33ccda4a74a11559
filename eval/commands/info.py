"""What a log holds: topics, counts, rates, gaps, clocks, and what is wrong with it.

examples:
  crosscue info drive.mcap
  crosscue info drive.mcap can0.log --json > drive.json
  crosscue info --quick drive.bag      only what the file declares, and whether its end is missing
  crosscue info https://host/drive.mcap --from 60 --to 62

Offset and drift say how the header stamp (else the publish time) runs against the log time.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from enum import Enum
from pathlib import Path

from crosscue.eval.commands.shared.options import (
    add_part_arguments,
    limits_of,
    print_json,
    selection_of,
)
from crosscue.eval.commands.shared.progress import Done, with_progress
from crosscue.eval.pipeline.drive_time import plan_for_time, time_segments
from crosscue.replay.clocks.findings import instant_text
from crosscue.replay.columns import Block
from crosscue.replay.log_summary import (
    LogSummary,
    Progress,
    Together,
    TopicSummary,
    quick_summary,
    rows_of_clocks,
    span_sentence,
    summarise,
    together,
)
from crosscue.replay.opening import open_logs
from crosscue.replay.safe_text import table, terminal_width, visible, wrapped
from crosscue.replay.time.scan import LogWatch, timeline_from
from crosscue.replay.time.segments import Timeline, gaps_text
from crosscue.replay.vehicle.vehicle import Vehicle, load

LOSSES_SHOWN = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("logs", nargs="+", metavar="LOG", help="recordings; paths or URLs")
    add_part_arguments(parser)
    parser.add_argument(
        "--vehicle", type=Path, metavar="V.toml", help="where the wheel speeds are, to find gaps"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="print what the log declares and whether its end is missing, without reading its body",
    )


def run(args: argparse.Namespace) -> int:
    """Look at each log and print what it holds.

    Returns:
        0 when all logs are whole, 3 when something is dropped or there is more than one segment.
    """
    vehicle = load(args.vehicle) if args.vehicle else Vehicle(version=1)
    timeline = None
    with open_logs(args.logs, limits_of(args)) as logs:
        if args.quick:
            summaries = [quick_summary(log) for log in logs]
        else:
            part = selection_of(args, logs)
            planned, clocks = plan_for_time(logs, vehicle, part)
            watches = [LogWatch(i, planned, vehicle, clocks[i]) for i in range(len(logs))]
            summaries = [
                summarise(log, _progress(args, watch), part)
                for log, watch in zip(logs, watches, strict=True)
            ]
            timeline = timeline_from(watches, planned, vehicle)
    common = together(summaries) if len(summaries) > 1 and not args.quick else None
    if args.json:
        reported = None if timeline is None else time_segments(timeline).as_json()
        print_json(
            {
                "logs": [plain(s) for s in summaries],
                "together": plain(common),
                "time": plain(reported),
            }
        )
    else:
        width = terminal_width()
        for summary in summaries:
            print("\n".join(lines_of(summary, width)))
        if common is not None:
            print("\n".join(_lines_together(common, width)))
        if timeline is not None and timeline.has_gaps:
            print("\n".join(_segments(timeline, width)))
    has_gaps = timeline is not None and timeline.has_gaps
    return 3 if has_gaps or not all(summary.is_whole for summary in summaries) else 0


def plain(value: object) -> object:
    """A dataclass as dictionaries, lists and scalars, with texts made visible."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Enum):
        return plain(value.value)
    if isinstance(value, Mapping):
        return {visible(str(key)): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return visible(value) if isinstance(value, str) else value


def lines_of(summary: LogSummary, width: int) -> Iterator[str]:
    """A summary as lines of text no wider than ``width``, as far as its numbers allow."""
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
        + (f" {i.rate_hz:.3g} Hz" if i.rate_hz else f" {i.count} times")
        for i in bus.can_ids
    )
    most = "most frequent: " if bus.can_id_count > len(bus.can_ids) else ""
    return f"{bus.can_id_count} ids; {most}{named}"


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
        texts.append("to write what can be read: crosscue convert LOG -o OUT.mcap --salvage")
    yield from _bullets("losses", texts, width)


def _lines_together(common: Together, width: int) -> Iterator[str]:
    if common.start_ns is None:
        yield wrapped("no time in common", width, "together   ")
    else:
        yield wrapped(span_sentence(common.start_ns, common.end_ns), width, "together   ")
    yield from (wrapped(sentence, width) for sentence in common.findings)


def _bullets(title: str, sentences: Iterable[str], width: int) -> Iterator[str]:
    lines = [wrapped(sentence, width) for sentence in sentences]
    if lines:
        yield from (title, *lines, "")


def _or_dash(count: int | None) -> str:
    return "-" if count is None else str(count)


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


def _progress(args: argparse.Namespace, watch: LogWatch) -> Progress:
    def watched(blocks: Iterable[Block]) -> Iterator[Block]:
        for block in blocks:
            watch.add(block)
            yield block

    return lambda blocks, rows: with_progress(
        watched(blocks), lambda: Done(*rows(), "rows"), args, "reading"
    )
