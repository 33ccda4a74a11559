"""Summary of a log from a single pass: topics, clocks, account and findings.

``summarise_log`` reads the log. ``crosscue info --json`` prints the fields of ``LogSummary``.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.base import EVERYTHING, Log, Selection, name_of, report_missing
from crosscue.replay.clocks.findings import (
    ROWS_FOR_OFFSET,
    apart,
    duration_text,
    findings,
    instant_text,
)
from crosscue.replay.clocks.reports import ClockReport, ClockWatch
from crosscue.replay.columns import Block, CanFrames, Images, Messages, Topic
from crosscue.replay.decode import Decoder, decoder_for
from crosscue.replay.decode.interfaces import why_not_decoded
from crosscue.replay.errors import SchemaError
from crosscue.replay.ledger import Detail, Ledger, TopicAccount
from crosscue.replay.progress import Progress, emit
from crosscue.replay.safe_text import counted
from crosscue.replay.seal.log import sealed_sentence
from crosscue.replay.vehicle.roles import Role, role_of


def copies(block: Block) -> int:
    """Return the number of rows that are exact copies of the row before.

    The stamp is that of the sensor where it is set; a recorder may store a copy a moment later.
    """
    same = np.diff(block.log_ns) == 0
    if block.header_ns is not None:
        is_set = block.header_ns[1:] > 0
        same = np.where(is_set, np.diff(block.header_ns) == 0, same)
    if not same.any():
        return 0
    rows = block.rows
    if isinstance(rows, Messages | Images):
        messages = rows.bytes_ if isinstance(rows, Images) else rows
        same &= np.diff(messages.stop - messages.start) == 0
        at = np.flatnonzero(same).tolist()
        return sum(messages.payload(i) == messages.payload(i + 1) for i in at)
    columns = _can(rows) if isinstance(rows, CanFrames) else rows.columns.values()
    for column in columns:
        equal = (column[1:] == column[:-1]) | ((column[1:] != column[1:]) & _nan(column[:-1]))
        same &= equal.reshape(len(same), -1).all(axis=1)
    return int(same.sum())


def _can(rows: CanFrames) -> Iterator[NDArray[np.generic]]:
    yield from (rows.arbitration_id, rows.is_extended, rows.kind, rows.length, rows.data)


def _nan(column: NDArray[np.generic]) -> NDArray[np.bool_]:
    return np.asarray(column != column, np.bool_)


CAN_IDS_SHOWN: Final = 10
_CAN_IDS_COUNTED: Final = 100_000
_EXTENDED: Final = 1 << 31
_NEEDS_A_LINE: Final = (Role.CAMERA, Role.CAN)


@dataclass(frozen=True, slots=True)
class CanIdCount:
    """Number of frames with one identifier on a bus.

    Attributes:
        arbitration_id: The identifier.
        is_extended: True for a 29-bit identifier.
        count: Number of frames.
        rate_hz: Frames per second over the bus's duration, or None where the duration is 0.
    """

    arbitration_id: int
    is_extended: bool
    count: int
    rate_hz: float | None


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """One topic of a log.

    Attributes:
        name: Name as stored in the log.
        type_name: Message type.
        encoding: Message encoding.
        used_as: Role of the topic without configuration, or None.
        declared: Number of rows that the log declares, or None.
        found: Number of rows found in the bytes; with ``--quick`` this and all below are empty.
        used: Number of rows yielded and decoded.
        skipped: Number of rows found and not used, by reason.
        dropped: Number of rows that were in the file and could not be read, by reason.
        dropped_unknown: Reasons of losses of unknown extent.
        rate_hz: Mean rate on the clock in use, or None.
        clocks: Clocks of the topic, or None where no row was read.
        can_ids: Most frequent identifiers of a CAN bus.
        can_id_count: Number of different identifiers on a CAN bus.
        duplicates: Number of rows with the stamp and the content of the row before.
    """

    name: str
    type_name: str
    encoding: str
    used_as: str | None
    declared: int | None
    found: int
    used: int
    skipped: Mapping[str, int]
    dropped: Mapping[str, int]
    dropped_unknown: tuple[str, ...]
    rate_hz: float | None
    clocks: ClockReport | None
    can_ids: tuple[CanIdCount, ...]
    can_id_count: int
    duplicates: int = 0


@dataclass(frozen=True, slots=True)
class LogSummary:
    """Summary of one log.

    Attributes:
        path: Path or URL as the user wrote it.
        format: Short name of the format.
        is_quick: True if only the declared contents were examined and the body was not read.
        is_whole: True if no row is known to be dropped; without meaning if ``is_quick``.
        integrity: A sentence on the verified checksums.
        seal: A sentence on the seal, its date and its hash.
        start_ns: Lowest log time of all topics, or None without rows.
        end_ns: Highest log time of all topics, or None without rows.
        topics: Summaries of the topics, sorted by name.
        unattributed_dropped: Number of dropped rows of unknown topics, by reason.
        unattributed_unknown: Reasons of losses of unknown extent and unknown topics.
        findings: Problems and peculiarities, one sentence each.
        notices: Remarks of the reader, one sentence each.
        drops: The first losses with their details.
    """

    path: str
    format: str
    is_quick: bool
    is_whole: bool
    integrity: str
    seal: str
    start_ns: int | None
    end_ns: int | None
    topics: tuple[TopicSummary, ...]
    unattributed_dropped: Mapping[str, int]
    unattributed_unknown: tuple[str, ...]
    findings: tuple[str, ...]
    notices: tuple[str, ...]
    drops: tuple[Detail, ...]


@dataclass(frozen=True, slots=True)
class Together:
    """The common time range of several logs of one drive.

    Attributes:
        start_ns: Start of the time range covered by all logs, or None if it is empty.
        end_ns: End of that time range, or None if it is empty.
        findings: Problems of the combination, one sentence each.
    """

    start_ns: int | None
    end_ns: int | None
    findings: tuple[str, ...]


@dataclass(slots=True)
class _CanIds:
    """Counts of one bus's identifiers, limited to ``_CAN_IDS_COUNTED`` different identifiers."""

    counts: Counter[int] = field(default_factory=Counter)

    def see(self, frames: CanFrames) -> None:
        keys = frames.arbitration_id.astype(np.int64) + frames.is_extended * _EXTENDED
        for key, count in zip(*np.unique(keys, return_counts=True), strict=True):
            if key in self.counts or len(self.counts) < _CAN_IDS_COUNTED:
                self.counts[int(key)] += int(count)

    def top(self, duration_s: float) -> tuple[CanIdCount, ...]:
        frequent = sorted(self.counts.items(), key=lambda item: (-item[1], item[0]))[:CAN_IDS_SHOWN]
        return tuple(
            CanIdCount(
                key % _EXTENDED, key >= _EXTENDED, n, n / duration_s if duration_s > 0 else None
            )
            for key, n in frequent
        )


def quick_summary(log: Log) -> LogSummary:
    """Summarise what a log declares and whether its end is missing, without reading its body."""
    ledger = Ledger(name_of(log))
    for topic in log.topics:
        ledger.declare(topic.name, topic.declared)
    report_missing(log, ledger)
    return _summary(log, ledger, ClockWatch(), {}, Counter(), is_quick=True)


def summarise_log(
    log: Log, selection: Selection = EVERYTHING, watch: Callable[[Block], None] = lambda block: None
) -> LogSummary:
    """Read a log, or a part of it, once and in bounded memory, and summarise it.

    Args:
        log: The log.
        selection: The part to read.
        watch: Called with each block as it is read.
    """
    ledger, clocks, can_ids = Ledger(name_of(log)), ClockWatch(), dict[str, _CanIds]()
    duplicates: Counter[str] = Counter()
    blocks = _watched(ledger.handing_on(log.read(ledger, selection)), log, ledger, watch)
    for block in _decoded(log, blocks, ledger):
        clocks.see(block)
        duplicates[block.topic] += copies(block)
        if isinstance(block.rows, CanFrames):
            can_ids.setdefault(block.topic, _CanIds()).see(block.rows)
    ledger.check()
    return _summary(log, ledger, clocks, can_ids, duplicates, is_quick=False)


def _watched(
    blocks: Iterable[Block], log: Log, ledger: Ledger, watch: Callable[[Block], None]
) -> Iterator[Block]:
    for block in blocks:
        watch(block)
        yield block
        emit(Progress("reading", rows_read(ledger), rows_declared(log), "rows"))


def common_span(summaries: Iterable[LogSummary]) -> Together:
    """Return the common time range of several logs."""
    spans = {
        s.path: (s.start_ns, s.end_ns)
        for s in summaries
        if s.start_ns is not None and s.end_ns is not None
    }
    starts, ends = zip(*spans.values(), strict=True) if spans else ((0,), (0,))
    start_ns, end_ns = max(starts), min(ends)
    if not spans or end_ns < start_ns:
        reported = apart(spans) or ("there is no time at which all of these logs have rows",)
        return Together(None, None, reported)
    return Together(start_ns, end_ns, apart(spans))


def rows_declared(log: Log) -> int:
    """Return the number of rows that a log declares."""
    return sum(topic.declared or 0 for topic in log.topics)


def rows_read(ledger: Ledger) -> int:
    """Return the number of rows found so far."""
    return sum(account.found for account in ledger.accounts.values())


def _decoded(log: Log, blocks: Iterable[Block], ledger: Ledger) -> Iterator[Block]:
    """Yield decoded blocks with header stamps; undecodable blocks keep their log times."""
    decoders: dict[str, Decoder] = {}
    for block in blocks:
        if not isinstance(block.rows, Messages):
            yield block
            continue
        if block.topic not in decoders:
            # Topics of a truncated file are discovered while reading, so the list is read again.
            decoders |= {t.name: _decoder_of(t) for t in log.topics if t.name not in decoders}
        yield decoders[block.topic](block, ledger)


def _decoder_of(topic: Topic) -> Decoder:
    """Return the topic's decoder, or one that skips every row with a reason."""
    try:
        decoder = decoder_for(topic)
        reason, detail = f"no decoder for encoding {topic.encoding!r}", topic.type_name
    except SchemaError as error:
        decoder, reason, detail = None, "its definition cannot be understood", str(error)
    if decoder is not None:
        return decoder
    reason = why_not_decoded(topic, reason)

    def skip(block: Block, ledger: Ledger, /) -> Block:
        if len(block):
            ledger.skip(block.topic, reason, len(block), detail, int(block.log_ns[0]))
        return block

    return skip


def _summary(
    log: Log,
    ledger: Ledger,
    clocks: ClockWatch,
    can_ids: Mapping[str, _CanIds],
    duplicates: Mapping[str, int],
    *,
    is_quick: bool,
) -> LogSummary:
    reports = clocks.reports()
    topics = tuple(
        _topic_summary(
            topic,
            ledger.topic(topic.name),
            reports.get(topic.name),
            can_ids.get(topic.name, _CanIds()),
            duplicates.get(topic.name, 0),
        )
        for topic in sorted(log.topics, key=lambda t: t.name)
    )
    log_clocks = [r.log for r in reports.values() if r.log.rows]
    nameless = ledger.accounts.get("", TopicAccount())
    return LogSummary(
        path=name_of(log),
        format=log.format,
        is_quick=is_quick,
        is_whole=ledger.is_whole,
        integrity="not examined" if is_quick else ledger.integrity,
        seal=sealed_sentence(log),
        start_ns=min((c.min_ns for c in log_clocks if c.min_ns is not None), default=None),
        end_ns=max((c.max_ns for c in log_clocks if c.max_ns is not None), default=None),
        topics=topics,
        unattributed_dropped=dict(nameless.dropped),
        unattributed_unknown=tuple(nameless.dropped_unknown),
        findings=(
            *_of_nameless(nameless),
            *_of_account(topics, is_quick=is_quick),
            *findings(reports),
            *_choices(topics),
        ),
        notices=tuple(ledger.notices),
        drops=tuple(ledger.drops()),
    )


def _topic_summary(
    topic: Topic, account: TopicAccount, report: ClockReport | None, seen: _CanIds, duplicates: int
) -> TopicSummary:
    role = role_of(topic)
    return TopicSummary(
        name=topic.name,
        type_name=topic.type_name,
        encoding=topic.encoding,
        used_as=None if role is None else role.value,
        declared=account.declared,
        found=account.found,
        used=account.used,
        skipped=dict(account.skipped),
        dropped=dict(account.dropped),
        dropped_unknown=tuple(account.dropped_unknown),
        rate_hz=None if report is None else report.rate_hz,
        clocks=report,
        can_ids=seen.top(0.0 if report is None else report.duration_ns * 1e-9),
        can_id_count=len(seen.counts),
        duplicates=duplicates,
    )


def _of_nameless(account: TopicAccount) -> Iterator[str]:
    """Yield findings on losses of unknown topics."""
    if not account.is_whole:
        why = ", ".join(dict.fromkeys([*account.dropped, *account.dropped_unknown]))
        at_least = "at least " if account.dropped_unknown else ""
        lost = counted(account.dropped.total(), "row")
        yield f"{at_least}{lost} of unknown topics dropped: {why}"


def _of_account(topics: Iterable[TopicSummary], *, is_quick: bool) -> Iterator[str]:
    for topic in topics:
        count = sum(topic.dropped.values())
        if count or topic.dropped_unknown:
            at_least = "at least " if topic.dropped_unknown else ""
            why = ", ".join(dict.fromkeys([*topic.dropped, *topic.dropped_unknown]))
            rows = counted(topic.found + count, "row")
            yield f"{topic.name}: {at_least}{count:,} of {rows} dropped: {why}"
        if topic.duplicates:
            copies = counted(topic.duplicates, "exact copy", "exact copies")
            yield f"{topic.name}: {copies} of the row before: same stamp, same content"
        if topic.used == 0 and topic.found:
            why = ", ".join(topic.skipped)
            yield f"{topic.name}: none of its {counted(topic.found, 'row')} can be used: {why}"
    if not is_quick and not any(topic.found for topic in topics):
        yield "it contains no rows"


def _choices(topics: Iterable[TopicSummary]) -> Iterator[str]:
    by_role: dict[str, list[str]] = {}
    for topic in topics:
        if topic.used_as is not None:
            by_role.setdefault(topic.used_as, []).append(topic.name)
    for role in _NEEDS_A_LINE:
        names = by_role.get(role.value, [])
        if len(names) > 1:
            listed = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
            yield (
                f"{len(names)} topics could be the {role.value} ({listed}): "
                "select one of them in the vehicle file"
            )


def rows_of_clocks(topics: Iterable[TopicSummary]) -> Iterator[tuple[str, ...]]:
    """Yield rows of the table of clocks: topic, clock, period, gaps, longest, offset, drift.

    Offset and drift refer to the clock in use. If that is the log time, they refer to the header
    stamp, else to the publish time.
    """
    for topic in topics:
        report = topic.clocks
        if report is None:
            continue
        stamps = report.of_used
        other = next((s for s in (report.header, report.publish) if s and s.line), None)
        line = (stamps.line or (other and other.line)) or None
        line = line if report.count >= ROWS_FOR_OFFSET else None
        drift = ""
        if line is not None and line.drift_ppm is not None:
            drift = f"{line.drift_ppm:+.1f} +-{line.drift_error_ppm:.1f}"
        yield (
            topic.name,
            report.used.value,
            "" if stamps.median_period_ns is None else duration_text(stamps.median_period_ns),
            str(stamps.gaps),
            "" if stamps.longest_step_ns is None else duration_text(stamps.longest_step_ns),
            "" if line is None else duration_text(line.offset_ns),
            drift,
        )


def span_sentence(start_ns: int | None, end_ns: int | None) -> str:
    """Describe a time range by its start, its end and its duration."""
    if start_ns is None or end_ns is None:
        return "no rows with a time from 1970 to 2115"
    span = f"{(end_ns - start_ns) * 1e-9:.2f} s"
    return f"{instant_text(start_ns)} to {instant_text(end_ns)} ({span})"
