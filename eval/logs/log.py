"""Read a recorded drive: its topics as tables, its camera as frames."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias

import numpy as np

from crosscue.eval.runs.tables.parquet import arrow_column, numpy_column
from crosscue.replay.base import EVERYTHING, Selection, name_of
from crosscue.replay.base import Log as OneLog
from crosscue.replay.columns import Block, CanFrames, Images, Messages, Table, Topic
from crosscue.replay.decode import Decoder, decoder_for
from crosscue.replay.decode.interfaces import why_not_decoded
from crosscue.replay.decode.packets import PacketDecoder, is_stream
from crosscue.replay.errors import MissingTopicError, SchemaError, UsageError
from crosscue.replay.files.closing import Closing
from crosscue.replay.ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC, Ledger, TopicAccount, warn_of
from crosscue.replay.limits import DEFAULT_LIMITS, Limits, LimitsGiven
from crosscue.replay.logs.log_part import LogPart, select_part
from crosscue.replay.logs.opening import open_log as open_one
from crosscue.replay.logs.opening import unless_damaged
from crosscue.replay.logs.topic_part import topic_columns
from crosscue.replay.losses import warn_of_loss
from crosscue.results import listing
from crosscue.verb import Option

if TYPE_CHECKING:
    import pyarrow as pa

    from crosscue.replay.columns import Bytes
    from crosscue.replay.vehicle.vehicle import Vehicle

VEHICLE: Final = "vehicle.toml"
NOT_ASKED: Final = (NOT_ASKED_TIME, NOT_ASKED_TOPIC)


def open(*paths: Path | str, limits: Limits = DEFAULT_LIMITS) -> Log:  # noqa: A001
    """Open a recorded drive: one log or several, in any supported format.

    Data are read when a topic, a frame or a summary is requested and, if the log has an index, only
    the necessary parts. Use the drive in a ``with`` block, or ``close`` it.

    Args:
        paths: Files, folders of data sets, or URLs.
        limits: Largest chunk, message and file to read.

    Returns:
        The drive; ``log.topics`` lists its topics, ``log["/imu"].table()`` reads one.

    Raises:
        UnknownFormatError: No reader supports the file or folder; the message lists the readers.
        LogError: The log is missing, not permitted, or has no readable record.
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


@dataclass(frozen=True, slots=True)
class UnopenedLog:
    """A drive that is not open yet, and the part of it to use.

    A function that accepts a drive opens it after all its other arguments have been checked.

    Attributes:
        paths: Files, folders of data sets, or URLs.
        part: The part to read.
        limits: Largest chunk, message and file to read.
    """

    paths: tuple[Path | str, ...] = field(repr=False)
    part: LogPart = field(default_factory=LogPart)
    limits: Limits = DEFAULT_LIMITS


@contextmanager
def opened(log: Log | UnopenedLog | Path | str) -> Iterator[Log]:
    """Open a drive for a ``with`` block; a drive that is already open is not closed."""
    with ExitStack() as files:
        if isinstance(log, UnopenedLog):
            drive = files.enter_context(open(*log.paths, limits=log.limits))
            files.enter_context(unless_damaged(drive.logs))
            yield replace(drive, selection=log.part.selected(drive.logs))
            return
        drive = log if isinstance(log, Log) else files.enter_context(open(log))
        with unless_damaged(drive.logs):
            yield drive


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Log(Closing):
    """A recorded drive, returned by ``crosscue.open``.

    ``log[name]`` is one topic. ``part`` selects a time span or some of the topics.

    Attributes:
        logs: The open readers, in the order of the paths.
        limits: Largest chunk, message and file to read.
        selection: The part to read.
    """

    logs: tuple[OneLog, ...]
    _files: ExitStack
    limits: Limits = DEFAULT_LIMITS
    selection: Selection = EVERYTHING

    @property
    def paths(self) -> tuple[str, ...]:
        """Paths or URLs of the logs, as passed."""
        return tuple(name_of(log) for log in self.logs)

    @property
    def topics(self) -> Topics:
        """Topics by name; known without reading the messages, if the format allows it."""
        return Topics(self)

    def __getitem__(self, name: str) -> LogTopic:
        return self.topics[name]

    def part(
        self,
        start_s: float | None = None,
        end_s: float | None = None,
        topics: Sequence[str] | None = None,
    ) -> Log:
        """Return the same drive, restricted to a part.

        Args:
            start_s: Start, in seconds after the first row; None for the beginning.
            end_s: End (exclusive), in seconds after the first row; None for the end.
            topics: Names of topics; None for all.

        Raises:
            UsageError: The time span is empty.
            MissingTopicError: The drive has no such topic.
        """
        with unless_damaged(self.logs):
            return replace(self, selection=select_part(self.logs, start_s, end_s, topics))

    def batches(
        self,
        topics: Sequence[str] | None = None,
        start_s: float | None = None,
        end_s: float | None = None,
    ) -> Iterator[tuple[str, pa.RecordBatch]]:
        """Yield the rows of all topics in one pass over the log, in bounded memory.

        Each batch comes with the name of its topic; batches are in the order of the log. Pictures
        and packets of video stay encoded: views of what was read, in the columns ``coding`` and
        ``data`` (with ``width_px``, ``height_px``, ``step_bytes`` and ``pixel_format`` where the
        log has them).
        Warnings report rows that are dropped, and topics and rows that cannot be decoded.

        Args:
            topics: Names of topics; None for all.
            start_s: Start, in seconds after the drive's first row; None for the beginning.
            end_s: End (exclusive), in seconds after the drive's first row; None for the end.

        Raises:
            UsageError: The time span is empty.
            MissingTopicError: The drive has no such topic.
        """
        with unless_damaged(self.logs):
            wanted = _narrowed(self.selection, select_part(self.logs, start_s, end_s, topics))
        for log in self.logs:
            yield from _batches_of(log, wanted)

    def signals(
        self, *databases: Path | str, bus: str | None = None, messages: Sequence[str] | None = None
    ) -> Signals:
        """Decode the signals of raw CAN frames, into one table per message.

        Args:
            databases: DBC, KCD, ARXML or SYM files.
            bus: Topic of the frames, if the drive has several buses.
            messages: Names of messages to decode; None for all.

        Returns:
            Tables by message, with units in their columns' metadata; see ``Signals``.

        Raises:
            UsageError: The drive has no CAN bus, or several and ``bus`` is None, or a message is
                not in the files.
            SchemaError: A file is not valid.
        """
        return _signals(self, [Path(name) for name in databases], bus, messages)

    def close(self) -> None:
        """Close the files."""
        self._files.close()

    def __repr__(self) -> str:
        names = ", ".join(f"{name_of(log)} ({log.format})" for log in self.logs)
        return f"{names}\n{self.topics!r}"


def unopened(*logs: str, part: LogPart, limits: LimitsGiven = DEFAULT_LIMITS) -> UnopenedLog:
    """Return a part of a drive, which a verb opens when its other arguments are checked.

    Args:
        logs: Recordings of one drive; paths or URLs.
        part: The part to read.
        limits: Limits for reading.
    """
    return UnopenedLog(logs, part, limits)


def unopened_one(log: str, part: LogPart, limits: LimitsGiven = DEFAULT_LIMITS) -> UnopenedLog:
    """Return a part of one log, as ``unopened`` does.

    Args:
        log: A recording, a data-set folder or a URL.
        part: The part to read.
        limits: Limits for reading.
    """
    return UnopenedLog((log,), part, limits)


def unopened_whole(*logs: Path, limits: LimitsGiven = DEFAULT_LIMITS) -> UnopenedLog:
    """Return a whole drive, as ``unopened`` returns a part.

    Args:
        logs: Recordings of one drive.
        limits: Limits for reading.
    """
    return UnopenedLog(logs, limits=limits)


def unopened_if_any(
    *logs: Annotated[Path, Option(may_be_empty=True)],
    part: LogPart,
    limits: LimitsGiven = DEFAULT_LIMITS,
) -> UnopenedLog | None:
    """Return a part of a drive, as ``unopened`` does; None without logs.

    Args:
        logs: Recordings of one drive.
        part: The part to read.
        limits: Limits for reading.
    """
    return UnopenedLog(logs, part, limits) if logs else None


# A drive, as a parameter of a verb: on the command line, ``LOG...`` and the part to read.
DriveGiven: TypeAlias = Annotated[Log | UnopenedLog | Path | str, Option(made_by=unopened)]
# A drive, as a parameter of a verb that can do without one.
DriveIfGiven: TypeAlias = Annotated[
    Log | UnopenedLog | Path | str | None, Option(made_by=unopened_if_any)
]
# One log, as a parameter of a verb.
LogGiven: TypeAlias = Annotated[Log | UnopenedLog | Path | str, Option(made_by=unopened_one)]
# A drive of which a verb chooses the part itself.
WholeDriveGiven: TypeAlias = Annotated[
    Log | UnopenedLog | Path | str, Option(made_by=unopened_whole)
]


@dataclass(frozen=True, slots=True, repr=False)
class Topics(Mapping[str, "LogTopic"]):
    """The topics of a drive by name; its repr is a table."""

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
        sources: Logs that contain it, each with its declaration of the topic, in the order in which
            rows are read.
    """

    log: Log
    sources: tuple[tuple[OneLog, Topic], ...]

    @property
    def name(self) -> str:
        """Name, as in the log."""
        return self.sources[0][1].name

    @property
    def type_name(self) -> str:
        """Type of its messages, as in the log."""
        return self.sources[0][1].type_name

    @property
    def encoding(self) -> str:
        """Encoding of its messages."""
        return self.sources[0][1].encoding

    @property
    def declared(self) -> int | None:
        """Number of messages that the log declares; None if it declares none."""
        counts = [topic.declared for _, topic in self.sources]
        known = [count for count in counts if count is not None]
        return sum(known) if len(known) == len(counts) else None

    def table(self, start_s: float | None = None, end_s: float | None = None) -> pa.Table:
        """Read its rows into one table in memory, with one column per field.

        Columns ``log_t_ns``, ``publish_ns`` and ``header_ns`` are in nanoseconds; the latter two
        exist only if every row has them. The account of every row is in the table's metadata
        (``table.schema.metadata[b"crosscue"]``, JSON). A warning reports rows that are dropped or
        cannot be decoded.

        Args:
            start_s: Start, in seconds after the drive's first row; None for the beginning.
            end_s: End (exclusive), in seconds after the drive's first row; None for the end.

        Raises:
            SchemaError: Its type cannot be decoded.
            UsageError: It contains pictures, or the time span is empty.
        """
        ledgers: list[Ledger] = []
        blocks = [*self._rows(self._selected(start_s, end_s), ledgers)]
        return _table_of(blocks, _report_text(self.name, ledgers))

    def batches(
        self, start_s: float | None = None, end_s: float | None = None
    ) -> Iterator[pa.RecordBatch]:
        """Yield the rows of ``table`` in batches, in bounded memory."""
        ledgers: list[Ledger] = []
        for block in self._rows(self._selected(start_s, end_s), ledgers):
            yield from _table_of([block], {}).to_batches()

    def frames(
        self, start_s: float | None = None, end_s: float | None = None
    ) -> Iterator[CameraFrame]:
        """Yield its pictures, still encoded; ``frame.rgb`` decodes them. Video is yielded decoded.

        Args:
            start_s: As in ``table``.
            end_s: As in ``table``.

        Raises:
            UsageError: It contains no pictures, or the time span is empty.
            SchemaError: Its type cannot be decoded.
        """
        from crosscue.detectors.images import encoded

        ledgers: list[Ledger] = []
        for block in self._blocks(self._selected(start_s, end_s), ledgers):
            if not isinstance(block.rows, Images):
                raise UsageError(f"{self.name}: {self.type_name} has no pictures; use table()")
            for row in range(len(block)):
                picture = encoded(block.rows, row)
                # Pixels of a video are its own already, and large.
                is_raw = picture.layout is not None
                content = picture.content if is_raw else bytes(picture.content)
                t_ns = int(block.log_ns[row])
                yield CameraFrame(t_ns, self.name, content, picture.coding, picture.layout)

    def _selected(self, start_s: float | None, end_s: float | None) -> Selection:
        part = _narrowed(self.log.selection, select_part(self.log.logs, start_s, end_s))
        return replace(part, topics=frozenset({self.name}))

    def _rows(self, selection: Selection, ledgers: list[Ledger]) -> Iterator[Block]:
        for block in self._blocks(selection, ledgers):
            if isinstance(block.rows, Images):
                raise UsageError(f"{self.name}: contains pictures; use frames()")
            yield block

    def _blocks(self, selection: Selection, ledgers: list[Ledger]) -> Iterator[Block]:
        """Yield decoded blocks; at the end, warn about missing rows."""
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
        t_ns: Log time.
        camera: Topic.
        encoded: Bytes of the picture, as stored; a view if ``coding`` is ``raw``.
        coding: Encoding of the bytes: ``jpeg``, ``png``, ``raw``, ...
        layout: Width, height, bytes per row and pixel format of a raw picture; else None.
    """

    t_ns: int
    camera: str
    encoded: bytes | memoryview
    coding: str
    layout: tuple[int, int, int, str] | None = None

    @property
    def rgb(self) -> Bytes:
        """Pixels in red, green and blue, uint8, shape (H, W, 3).

        Raises:
            LogFormatError: The picture is damaged, truncated, or of an unsupported encoding.
            LogTooLargeError: The picture has more pixels than the limit.
        """
        from crosscue.detectors.images import Encoded, decode

        pixels, _ = decode(Encoded(self.coding, memoryview(self.encoded), self.layout))
        return pixels[:, :, ::-1]

    def __repr__(self) -> str:
        return f"{self.camera} at {self.t_ns} ns: {self.coding}, {len(self.encoded):,} bytes"


class Signals(Mapping[str, "pa.Table"]):
    """Tables of CAN messages by name; each column is a signal, with its unit in the metadata.

    ``account`` has the numbers of decoded, skipped and dropped frames of the bus, with reasons.
    """

    def __init__(self, tables: Mapping[str, pa.Table], account: Mapping[str, object]) -> None:
        """Store tables and account."""
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
    """Return the named CAN bus, or the only one."""
    from crosscue.replay.vehicle.roles import Role, role_of

    if name is not None:
        return log[name]
    buses = [one for one in log.topics.values() if role_of(one.sources[0][1]) is Role.CAN]
    if len(buses) != 1:
        names = ", ".join(one.name for one in buses)
        what = f"several CAN buses: {names}; choose one with bus=" if buses else "no CAN bus in it"
        raise UsageError(f"{log.paths[0]}: {what}")
    return buses[0]


def _narrowed(part: Selection, wanted: Selection) -> Selection:
    """Return what is in both parts of a drive."""
    starts = [ns for ns in (part.start_ns, wanted.start_ns) if ns is not None]
    ends = [ns for ns in (part.end_ns, wanted.end_ns) if ns is not None]
    topics = [one for one in (part.topics, wanted.topics) if one is not None]
    return Selection(
        frozenset.intersection(*topics) if topics else None,
        max(starts, default=None),
        min(ends, default=None),
    )


def _batches_of(log: OneLog, wanted: Selection) -> Iterator[tuple[str, pa.RecordBatch]]:
    import pyarrow as pa

    decoders: dict[str, Decoder] = {}
    for topic in log.topics:
        if wanted.wants(topic.name):
            try:
                decoders[topic.name] = _decoder(log, topic)
            except SchemaError as error:
                warn_of_loss(f"{error}; no row of it is read")
    ledger = Ledger(name_of(log))
    part = replace(wanted, topics=frozenset(decoders))
    for block in ledger.handing_on(log.read(ledger, part)):
        decoded = decoders[block.topic](block, ledger)
        if len(decoded):
            arrays, schema = _columns_of([decoded])
            yield block.topic, pa.RecordBatch.from_arrays(arrays, schema=schema)
    ledger.check()
    for name in ("", *decoders):
        _warn(ledger, name)


def _decoder(log: OneLog, topic: Topic) -> Decoder:
    decode = decoder_for(topic)
    if decode is None:
        why = why_not_decoded(topic, f"encoding {topic.encoding!r} is not decoded")
        raise SchemaError(f"{name_of(log)}: {topic.name}: {topic.type_name}: {why}")
    return decode


def _table_of(blocks: Sequence[Block], reported: Mapping[str, object]) -> pa.Table:
    import pyarrow as pa

    if not blocks:
        empty = pa.array([], pa.int64())
        return pa.table([empty], names=["log_t_ns"], metadata=_metadata(reported))
    arrays, schema = _columns_of(blocks)
    return pa.table(arrays, schema.with_metadata(_metadata(reported)))


def _columns_of(blocks: Sequence[Block]) -> tuple[list[pa.Array | pa.ChunkedArray], pa.Schema]:
    """Return the rows of one topic as columns of Arrow, with their schema."""
    import pyarrow as pa

    units = blocks[0].rows.units if isinstance(blocks[0].rows, Table) else {}
    arrays = {name: numpy_column(values) for name, values in topic_columns(blocks).items()}
    pictures = [block.rows for block in blocks if isinstance(block.rows, Images)]
    frames = [block.rows for block in blocks if isinstance(block.rows, CanFrames)]
    content = [_views(one.bytes_) for one in pictures] or [_payloads(one) for one in frames]
    if pictures:
        codings = [coding for one in pictures for coding in one.coding]
        arrays["coding"] = arrow_column(codings, pa.string())
    if content:
        arrays["data"] = content[0] if len(content) == 1 else pa.chunked_array(content)
    fields = [
        pa.field(name, array.type, metadata={"unit": units[name]} if units.get(name) else None)
        for name, array in arrays.items()
    ]
    return list(arrays.values()), pa.schema(fields)


def _views(messages: Messages) -> pa.Array:
    """Return messages as views of their buffer, which is not copied.

    A view has the length, then either up to 12 bytes, or 4 bytes, a buffer and the place in it.
    """
    import pyarrow as pa

    length = messages.stop - messages.start
    views = np.zeros((len(messages), 4), np.int32)
    views[:, 0] = length
    views[:, 3] = np.where(length > 12, messages.start, 0)
    inline, k = views.view(np.uint8)[:, 4:], np.arange(12)
    has = (k < length[:, None]) & ((k < 4) | (length <= 12)[:, None])
    inline[has] = messages.buffer[(messages.start[:, None] + k)[has]]
    buffers = [None, pa.py_buffer(views), pa.py_buffer(messages.buffer)]
    return pa.Array.from_buffers(pa.binary_view(), len(messages), buffers)


def _payloads(rows: CanFrames) -> pa.Array:
    import pyarrow as pa

    size, width = rows.data.shape
    stop, content = np.arange(0, (size + 1) * width, width, dtype=np.int32), rows.data
    if np.count_nonzero(rows.length < width):
        length = np.minimum(rows.length, width)
        np.cumsum(length, out=stop[1:])
        content = content[np.arange(width) < length[:, None]]
    buffers = [None, pa.py_buffer(stop), pa.py_buffer(np.ascontiguousarray(content))]
    return pa.Array.from_buffers(pa.binary(), size, buffers)


def _metadata(reported: Mapping[str, object]) -> dict[str, str] | None:
    return {"crosscue": json.dumps(reported, sort_keys=True)} if reported else None


def _report_text(topic: str, ledgers: Sequence[Ledger]) -> dict[str, object]:
    """Return the account of every row of a topic, by log."""
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
    warn_of(ledger, topic)
    for reason, count in sorted(ledger.topic(topic).skipped.items()):
        if reason not in NOT_ASKED:
            text = f"{ledger.log}: {topic}: {count} rows skipped: {reason}"
            warn_of_loss(text)


def vehicle_of(log: Log | UnopenedLog | Path | str, given: Vehicle | Path | str | None) -> Vehicle:
    """Return the given settings, or those of the ``vehicle.toml`` next to the log, or defaults."""
    from crosscue.replay.vehicle.vehicle import Vehicle, load, vehicle_given

    if given is not None:
        return vehicle_given(given)
    paths = log.paths if isinstance(log, Log | UnopenedLog) else (log,)
    for path in map(Path, paths):
        beside = (path if path.is_dir() else path.parent) / VEHICLE
        if beside.is_file():
            return load(beside)
    return Vehicle(version=1)
