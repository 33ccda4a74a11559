"""A recorded drive, open for reading: its topics as tables, its camera as frames."""

from __future__ import annotations

import difflib
import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from crosscue.eval.interface.show import listing
from crosscue.replay.base import (
    DEFAULT_LIMITS,
    EVERYTHING,
    NOT_ASKED_TIME,
    NOT_ASKED_TOPIC,
    Block,
    CanFrames,
    Closing,
    Images,
    Ledger,
    Limits,
    LossWarning,
    MissingTopicError,
    SchemaError,
    Selection,
    Table,
    Topic,
    TopicAccount,
    UsageError,
    name_of,
    warn_of,
)
from crosscue.replay.base import Log as OneLog
from crosscue.replay.decode import Decoder, decoder_for
from crosscue.replay.decode.interfaces import why_not_decoded
from crosscue.replay.decode.packets import PacketDecoder, is_stream
from crosscue.replay.logs.log_part import part_of
from crosscue.replay.logs.opening import open_log as open_one
from crosscue.replay.logs.opening import unless_damaged
from crosscue.replay.logs.topic_part import columns_of

if TYPE_CHECKING:
    import pyarrow as pa

    from crosscue.eval.interface.logs.summary import DriveSummary
    from crosscue.replay.base import Bytes
    from crosscue.replay.logs.log_summary import Progress
    from crosscue.replay.vehicle.vehicle import Vehicle

NOT_ASKED: Final = (NOT_ASKED_TIME, NOT_ASKED_TOPIC)


def open(*paths: Path | str, limits: Limits = DEFAULT_LIMITS) -> Log:  # noqa: A001
    """Open a recorded drive: one log or several, in any format that crosscue reads.

    The log is read when a topic, a frame or a summary is asked for, and only as far as its index
    says is necessary. Use it in a ``with`` block, or ``close`` it.

    Args:
        paths: Files, folders of data sets, or URLs.
        limits: The largest chunk, message and file that are read.

    Returns:
        The drive; ``log.topics`` lists what it holds, ``log["/imu"].table()`` reads.

    Raises:
        UnknownFormatError: No reader knows the file or folder; the message lists those there are.
        LogError: It is missing, not permitted, or has no readable record.
    """
    if not paths:
        raise UsageError("open: no log named; expected one path or more")
    files = ExitStack()
    try:
        logs = tuple(files.enter_context(open_one(path, limits)) for path in paths)
    except BaseException:
        files.close()
        raise
    return Log(logs, files, limits)


@contextmanager
def opened(log: Log | Path | str) -> Iterator[Log]:
    """The drive, open as long as the ``with`` block lasts; one that was open stays so."""
    with ExitStack() as files:
        drive = log if isinstance(log, Log) else files.enter_context(open(log))
        with unless_damaged(drive.logs):
            yield drive


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Log(Closing):
    """A recorded drive; make one with ``crosscue.open``.

    ``log[name]`` is one topic. ``part`` restricts everything that follows to a span of time or to
    some topics.

    Attributes:
        logs: The open readers, in the order given.
        limits: The largest chunk, message and file that are read.
        selection: The part that is read.
    """

    logs: tuple[OneLog, ...]
    _files: ExitStack
    limits: Limits = DEFAULT_LIMITS
    selection: Selection = EVERYTHING

    @property
    def paths(self) -> tuple[str, ...]:
        """Where the logs are, as given."""
        return tuple(name_of(log) for log in self.logs)

    @property
    def topics(self) -> Topics:
        """What the drive holds, by name; known without reading it wherever the format allows."""
        return Topics(self)

    def __getitem__(self, name: str) -> LogTopic:
        return self.topics[name]

    def part(
        self,
        start_s: float | None = None,
        end_s: float | None = None,
        topics: Sequence[str] | None = None,
    ) -> Log:
        """The same drive, of which only a part is read.

        Args:
            start_s: Seconds after the first row, or None for the beginning.
            end_s: Seconds after the first row, no longer wanted (half open), or None for the end.
            topics: Names, or None for all.

        Raises:
            UsageError: An empty span.
            MissingTopicError: The drive has no such topic.
        """
        with unless_damaged(self.logs):
            return replace(self, selection=part_of(self.logs, start_s, end_s, topics))

    def summary(
        self,
        vehicle: Vehicle | None = None,
        *,
        quick: bool = False,
        progress: Progress | None = None,
    ) -> DriveSummary:
        """Topics, counts, rates, gaps, clocks and account, read in one pass.

        Args:
            vehicle: Where the wheel speeds are, to find gaps; None for what the log itself says.
            quick: Only what the log says of itself; its body is not read.
            progress: Passes blocks on while it shows how far the work is.
        """
        from crosscue.eval.interface.logs.summary import summary_of
        from crosscue.replay.vehicle.vehicle import Vehicle

        settings = vehicle or Vehicle(version=1)
        return summary_of(self.logs, self.selection, settings, quick=quick, progress=progress)

    def signals(
        self, *databases: Path | str, bus: str | None = None, messages: Sequence[str] | None = None
    ) -> Signals:
        """The signals of raw CAN frames, a table for each message.

        Args:
            databases: DBC, KCD, ARXML or SYM files.
            bus: The topic of the frames, where the drive has several buses.
            messages: Only these, by name; None for all.

        Returns:
            Tables by message, units in their columns' metadata; see ``Signals``.

        Raises:
            UsageError: No CAN bus, several and none chosen, or a message the files lack.
            SchemaError: A file cannot be understood.
        """
        return _signals(self, [Path(name) for name in databases], bus, messages)

    def close(self) -> None:
        """Close the files; nothing can be read afterwards."""
        self._files.close()

    def __repr__(self) -> str:
        names = ", ".join(f"{name_of(log)} ({log.format})" for log in self.logs)
        return f"{names}\n{self.topics!r}"


@dataclass(frozen=True, slots=True, repr=False)
class Topics(Mapping[str, "LogTopic"]):
    """The topics of a drive by name; printed as a table."""

    log: Log

    def __getitem__(self, name: str) -> LogTopic:
        found = [
            (log, topic) for log in self.log.logs for topic in log.topics if topic.name == name
        ]
        if not found:
            close = difflib.get_close_matches(name, list(self), n=1)
            hint = f"did you mean {close[0]}?" if close else f"there are: {', '.join(self)}"
            raise MissingTopicError(f"{self.log.paths[0]}: no topic {name!r}; {hint}")
        return LogTopic(self.log, tuple(found))

    def __iter__(self) -> Iterator[str]:
        wanted = self.log.selection.wants
        names = {t.name for log in self.log.logs for t in log.topics if wanted(t.name)}
        return iter(sorted(names))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __contains__(self, name: object) -> bool:
        return any(name == known for known in self)

    def __repr__(self) -> str:
        rows = [(t.name, t.type_name, t.encoding, t.declared) for t in self.values()]
        return listing(("topic", "type", "encoding", "count"), rows, 3)


@dataclass(frozen=True, slots=True, repr=False)
class LogTopic:
    """One topic of a drive.

    Attributes:
        log: The drive.
        sources: The logs that have it, and what each says of it; rows come in this order.
    """

    log: Log
    sources: tuple[tuple[OneLog, Topic], ...]

    @property
    def name(self) -> str:
        """As the log spells it."""
        return self.sources[0][1].name

    @property
    def type_name(self) -> str:
        """Type of its messages, as the log spells it."""
        return self.sources[0][1].type_name

    @property
    def encoding(self) -> str:
        """How its messages are coded."""
        return self.sources[0][1].encoding

    @property
    def declared(self) -> int | None:
        """How many messages the format says there are; None where it says nothing."""
        counts = [topic.declared for _, topic in self.sources]
        known = [count for count in counts if count is not None]
        return sum(known) if len(known) == len(counts) else None

    def table(self, start_s: float | None = None, end_s: float | None = None) -> pa.Table:
        """Its rows as a table, a column for each field; all of it is held in memory.

        Columns ``log_t_ns``, ``publish_ns`` and ``header_ns`` are nanoseconds, the latter two where
        every row has them. What became of every row is in the table's metadata
        (``table.schema.metadata[b"crosscue"]``, JSON); rows that are dropped or cannot be decoded
        are warned of, too.

        Args:
            start_s: Seconds after the drive's first row, or None for the beginning.
            end_s: Seconds after the drive's first row, no longer wanted, or None for the end.

        Raises:
            SchemaError: Its type cannot be decoded.
            UsageError: It holds pictures; an empty span.
        """
        ledgers: list[Ledger] = []
        blocks = [*self._rows(self._selected(start_s, end_s), ledgers)]
        return _table_of(blocks, _report_text(self.name, ledgers))

    def batches(
        self, start_s: float | None = None, end_s: float | None = None
    ) -> Iterator[pa.RecordBatch]:
        """As ``table``, a batch at a time: memory does not grow with the log."""
        ledgers: list[Ledger] = []
        for block in self._rows(self._selected(start_s, end_s), ledgers):
            yield from _table_of([block], {}).to_batches()

    def frames(
        self, start_s: float | None = None, end_s: float | None = None
    ) -> Iterator[CameraFrame]:
        """Its pictures one by one, still encoded; ``frame.rgb`` decodes. Video comes decoded.

        Args:
            start_s: As in ``table``.
            end_s: As in ``table``.

        Raises:
            UsageError: It holds no pictures; an empty span.
            SchemaError: Its type cannot be decoded.
        """
        from crosscue.detectors.images import encoded

        ledgers: list[Ledger] = []
        for block in self._blocks(self._selected(start_s, end_s), ledgers):
            if not isinstance(block.rows, Images):
                raise UsageError(f"{self.name}: {self.type_name} has no pictures; use table()")
            for row in range(len(block)):
                picture = encoded(block.rows, row)
                content = bytes(picture.content)
                t_ns = int(block.log_ns[row])
                yield CameraFrame(t_ns, self.name, content, picture.coding, picture.layout)

    def _selected(self, start_s: float | None, end_s: float | None) -> Selection:
        of_log, wanted = self.log.selection, part_of(self.log.logs, start_s, end_s)
        starts = [ns for ns in (of_log.start_ns, wanted.start_ns) if ns is not None]
        ends = [ns for ns in (of_log.end_ns, wanted.end_ns) if ns is not None]
        return Selection(frozenset({self.name}), max(starts, default=None), min(ends, default=None))

    def _rows(self, selection: Selection, ledgers: list[Ledger]) -> Iterator[Block]:
        """Blocks of columns."""
        for block in self._blocks(selection, ledgers):
            if isinstance(block.rows, Images):
                raise UsageError(f"{self.name}: holds pictures; use frames()")
            yield block

    def _blocks(self, selection: Selection, ledgers: list[Ledger]) -> Iterator[Block]:
        """Decoded blocks; once exhausted, what is missing has been warned of."""
        decoders = [_decoder(log, topic) for log, topic in self.sources]
        for (log, _), decode in zip(self.sources, decoders, strict=True):
            ledger = Ledger(name_of(log))
            ledgers.append(ledger)
            packets: PacketDecoder | None = None
            for block in ledger.handing_on(log.read(ledger, selection)):
                decoded = decode(block, ledger)
                if isinstance(decoded.rows, Images) and is_stream(decoded.rows):
                    packets = packets or PacketDecoder(self.name, ledger)
                    yield from packets(decoded)
                elif len(decoded):
                    yield decoded
            if packets is not None:
                yield from packets.flush()
            ledger.check()
            _warn(ledger, self.name)

    def __repr__(self) -> str:
        count = "" if self.declared is None else f", {self.declared:,} messages"
        return f"{self.name}: {self.type_name} ({self.encoding}){count}"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class CameraFrame:
    """One picture of a log.

    Attributes:
        t_ns: When the recorder stored it, log time.
        camera: Topic.
        encoded: Its bytes as stored.
        coding: How they are coded: ``jpeg``, ``png``, ``raw``, ...
        layout: Of a raw picture width, height, bytes a row and pixel format; else None.
    """

    t_ns: int
    camera: str
    encoded: bytes
    coding: str
    layout: tuple[int, int, int, str] | None = None

    @property
    def rgb(self) -> Bytes:
        """Its pixels in red, green and blue, uint8 of shape (H, W, 3).

        Raises:
            LogFormatError: Damaged, cut short, or of a coding that is not decoded.
            LogTooLargeError: More pixels than are decoded.
        """
        from crosscue.detectors.images import Encoded, decode

        pixels, _ = decode(Encoded(self.coding, memoryview(self.encoded), self.layout))
        return pixels[:, :, ::-1]

    def __repr__(self) -> str:
        return f"{self.camera} at {self.t_ns} ns: {self.coding}, {len(self.encoded):,} bytes"


class Signals(Mapping[str, "pa.Table"]):
    """Tables of CAN messages by name; each column is a signal, its unit in the field's metadata.

    ``account`` says what became of every frame of the bus, by reason.
    """

    def __init__(self, tables: Mapping[str, pa.Table], account: Mapping[str, object]) -> None:
        """Keep both."""
        self._tables: Final = dict(tables)
        self.account: Final = account

    def __getitem__(self, message: str) -> pa.Table:
        if message not in self._tables:
            close = difflib.get_close_matches(message, self._tables, n=1)
            hint = f"did you mean {close[0]}?" if close else f"there are: {', '.join(self)}"
            raise MissingTopicError(f"no message {message!r} was decoded; {hint}")
        return self._tables[message]

    def __iter__(self) -> Iterator[str]:
        return iter(self._tables)

    def __len__(self) -> int:
        return len(self._tables)

    def __repr__(self) -> str:
        rows = [
            (name, ", ".join(c for c in table.column_names if not c.endswith("_ns")), len(table))
            for name, table in self._tables.items()
        ]
        return listing(("message", "signals", "rows"), rows, 2)


def _signals(
    log: Log, databases: Sequence[Path], bus: str | None, messages: Sequence[str] | None
) -> Signals:
    from crosscue.replay.can.database import CanDatabase
    from crosscue.replay.can.decode import BusDecoder

    topic = _bus(log, bus)
    database = CanDatabase.load(databases)
    ledgers: list[Ledger] = []
    decoders: list[BusDecoder] = []
    parts: dict[str, list[Block]] = {}
    for block in topic._rows(topic._selected(None, None), ledgers):
        if len(decoders) < len(ledgers):
            try:
                decoders = [BusDecoder(database, topic.name, one, messages) for one in ledgers]
            except ValueError as error:
                raise UsageError(f"messages: {error}") from None
        for found in decoders[-1](block):
            if len(found):
                parts.setdefault(found.topic.removeprefix(f"{topic.name}/"), []).append(found)
    account = _report_text(topic.name, ledgers)
    return Signals({name: _table_of(parts[name], account) for name in sorted(parts)}, account)


def _bus(log: Log, name: str | None) -> LogTopic:
    """The one CAN bus, or the one that is named."""
    from crosscue.replay.vehicle.roles import Role, role_of

    if name is not None:
        return log[name]
    buses = [one for one in log.topics.values() if role_of(one.sources[0][1]) is Role.CAN]
    if len(buses) != 1:
        names = ", ".join(one.name for one in buses)
        what = f"several CAN buses: {names}; choose one with bus=" if buses else "no CAN bus in it"
        raise UsageError(f"{log.paths[0]}: {what}")
    return buses[0]


def _decoder(log: OneLog, topic: Topic) -> Decoder:
    decode = decoder_for(topic)
    if decode is None:
        why = why_not_decoded(topic, f"encoding {topic.encoding!r} is not decoded")
        raise SchemaError(f"{name_of(log)}: {topic.name}: {topic.type_name}: {why}")
    return decode


def _table_of(blocks: Sequence[Block], reported: Mapping[str, object]) -> pa.Table:
    import pyarrow as pa

    if not blocks:
        return pa.table({"log_t_ns": pa.array([], pa.int64())}, metadata=_metadata(reported))
    units = blocks[0].rows.units if isinstance(blocks[0].rows, Table) else {}
    arrays = {name: pa.array(values) for name, values in columns_of(blocks).items()}
    if isinstance(blocks[0].rows, CanFrames):
        arrays["data"] = pa.chunked_array([_payloads(block.rows) for block in blocks])
    fields = [
        pa.field(name, array.type, metadata={"unit": units[name]} if units.get(name) else None)
        for name, array in arrays.items()
    ]
    return pa.table(list(arrays.values()), pa.schema(fields, metadata=_metadata(reported)))


def _payloads(rows: object) -> pa.Array:
    """Bytes of each CAN frame, as many as it carries."""
    import pyarrow as pa

    assert isinstance(rows, CanFrames)
    width = rows.data.shape[1]
    length = np.minimum(rows.length, width).astype(np.int32)
    stop = np.concatenate([[0], np.cumsum(length, dtype=np.int32)]).astype(np.int32)
    content = rows.data[np.arange(width) < length[:, None]]
    return pa.Array.from_buffers(
        pa.binary(), len(rows), [None, pa.py_buffer(stop), pa.py_buffer(content)]
    )


def _metadata(reported: Mapping[str, object]) -> dict[str, str] | None:
    return {"crosscue": json.dumps(reported, sort_keys=True)} if reported else None


def _report_text(topic: str, ledgers: Sequence[Ledger]) -> dict[str, object]:
    """What became of every row of a topic, by log."""
    return {
        ledger.log: _account(ledger.topic(topic))
        | {"unattributed": _account(ledger.accounts.get("", TopicAccount()))}
        for ledger in ledgers
    }


def _account(of: TopicAccount) -> dict[str, object]:
    return {
        "declared": of.declared,
        "found": of.found,
        "used": of.used,
        "skipped": dict(of.skipped),
        "dropped": dict(of.dropped),
        "dropped_unknown": of.dropped_unknown,
    }


def _warn(ledger: Ledger, topic: str) -> None:
    """Warn of rows that are dropped or that nobody could decode."""
    warn_of(ledger)
    for reason, count in sorted(ledger.topic(topic).skipped.items()):
        if reason not in NOT_ASKED:
            text = f"{ledger.log}: {topic}: {count} rows skipped: {reason}"
            warnings.warn(text, LossWarning, stacklevel=4)
