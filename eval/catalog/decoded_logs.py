"""Decoding of all streams of a drive to Parquet, one file for each topic or CAN message."""

from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.logs.log import DriveGiven, opened, vehicle_of
from crosscue.eval.pipeline.drive_time import time_segments, whole_timeline
from crosscue.eval.pipeline.empty_result import empty_result, nothing_left
from crosscue.eval.runs.account import Account, account, account_lines, details_of, reading_of
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder, clear, created, locked, staged, write_manifest
from crosscue.eval.runs.logs import log_names
from crosscue.eval.runs.manifest import DecodeManifest
from crosscue.eval.runs.tables.parquet import TableSink
from crosscue.eval.runs.tables.skipped import write_skipped
from crosscue.replay.base import Log, Selection
from crosscue.replay.columns import Block, CanFrames, Images, Messages, Table, Topic
from crosscue.replay.decode import Decoder, decoder_for
from crosscue.replay.decode.interfaces import why_not_decoded
from crosscue.replay.errors import SchemaError
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.log_summary import rows_declared, rows_read
from crosscue.replay.logs.topic_part import topic_columns
from crosscue.replay.mobileye.can.admit import all_ids
from crosscue.replay.mobileye.can.decode import MobileyeDecoder
from crosscue.replay.mobileye.ros.reader import RosMobileye
from crosscue.replay.mobileye.samples import mobileye_settings
from crosscue.replay.progress import Progress, emit
from crosscue.replay.time.segments import LogClock, TimedLog, Timeline, gaps_text
from crosscue.replay.vehicle.roles import Role, role_of
from crosscue.replay.vehicle.vehicle import Vehicle
from crosscue.replay.versions import versions
from crosscue.results import HIDDEN, Result, json_key

# Min rows of a row group; rows of a table are buffered until then.
ROWS_HELD: Final = 8192
# Name of the table of skipped and dropped rows.
RESERVED: Final = "skipped"


class _BlockDecoder(Protocol):
    def __call__(self, block: Block) -> list[Block]: ...


@dataclass(slots=True, eq=False)
class _Table:
    """One output file and its buffered rows."""

    run: RunFolder
    name: str
    stack: ExitStack
    timeline: Timeline
    clock: LogClock
    rows: int = 0
    sink: TableSink | None = None
    held: list[Block] = field(default_factory=list)
    held_rows: int = 0

    def add(self, block: Block) -> None:
        self.held.append(block)
        self.held_rows += len(block)
        if self.held_rows >= ROWS_HELD:
            self.write()

    def write(self) -> None:
        if not self.held:
            return
        columns = _labelled(topic_columns(self.held), self.timeline, self.clock)
        if self.sink is None:
            import pyarrow as pa

            schema = pa.table({name: values[:0] for name, values in columns.items()}).schema
            sink = TableSink(self.run, self.name, schema)
            self.sink = self.stack.enter_context(sink)
        self.sink.write(columns)
        self.rows += self.held_rows
        self.held, self.held_rows = [], 0


@dataclass(frozen=True, slots=True, repr=False)
class Decoded(Result):
    """A decoded drive; its ``repr`` lists the tables.

    Attributes:
        path: The folder of the tables.
        rows: Number of rows by file of a stream.
        account: Account of all rows.
        timeline: Time segments of the drive.
        details: Location and reason of the first dropped rows.
    """

    path: Path = field(metadata=HIDDEN)
    rows: dict[str, int] = field(metadata=json_key("tables"))
    account: Account
    timeline: Timeline = field(metadata=HIDDEN)
    details: list[str] = field(metadata=HIDDEN)

    also: ClassVar = {"time": "time"}

    def lines(self) -> Iterator[str]:
        """Yield the number of rows of each table, and the account."""
        width = max(map(len, self.rows), default=0)
        for name, count in self.rows.items():
            yield f"{name:{width}}  {count:>10,} rows"
        yield from (*account_lines(self.account), *self.details)
        for log in self.account.reading:
            yield from (f"note     {text}" for text in log.notices)
        yield from (f"note     {text}" for text in gaps_text(self.timeline.segments))

    @property
    def exit_status(self) -> int:
        """3 when anything was dropped or the logs have gaps, else 0."""
        return 3 if self.timeline.has_gaps or not self.account.is_whole else 0

    @property
    def time(self) -> object:
        """Time segments, as in the manifest."""
        return time_segments(self.timeline).as_json()


def decode(
    log: DriveGiven,
    output: Path | str,
    vehicle: Vehicle | Path | str | None = None,
    *,
    overwrite: bool = False,
) -> Decoded:
    """Decode every topic and CAN message into a Parquet file.

    Examples:
        crosscue decode drive.mcap --vehicle car.toml -o tables

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        output: Folder for the tables.
        vehicle: Vehicle file: DBC files, buses, mounting (default: vehicle.toml next to the log).
        overwrite: Replace existing tables.

    Raises:
        SchemaError: A DBC file is not valid.
        EmptyResultError: There is no row for any table; the folder is unchanged.
        OutputError: The folder has other contents, or cannot be written.
    """
    settings = vehicle_of(log, vehicle)
    with opened(log) as drive, created(Path(output), overwrite=overwrite) as folder:
        return decode_tables(Drive(drive.logs, settings, drive.selection), folder)


def decode_tables(drive: Drive, run: RunFolder) -> Decoded:
    """Write all streams of a drive as tables.

    Args:
        drive: The drive; its vehicle has DBC files, buses and the Mobileye's mounting.
        run: Folder for the tables; cleared first.

    Raises:
        SchemaError: A DBC file cannot be read.
        AccountError: The account of a topic does not balance.
        EmptyResultError: The selected part contains no row; the folder is unchanged.
        OutputError: The disk is full.
    """
    logs, vehicle, selection = drive.logs, drive.vehicle, drive.selection
    ledgers = tuple(map(Ledger, log_names(logs)))
    tables: dict[str, _Table] = {}
    declared = sum(map(rows_declared, logs))
    timeline = whole_timeline(drive)
    with locked(run), staged(run, always=True) as new, nothing_left(new):
        clear(new)
        with ExitStack() as stack:
            for number, (log, ledger) in enumerate(zip(logs, ledgers, strict=True)):
                clock = timeline.clock(number)
                for block in _decoded(TimedLog(log, clock), vehicle, ledger, selection):
                    if block.topic not in tables:
                        taken = {RESERVED, *(t.name.lower() for t in tables.values())}
                        name = table_file(block.topic, taken)
                        tables[block.topic] = _Table(new, name, stack, timeline, clock)
                    tables[block.topic].add(block)
                    emit(Progress("decoding", sum(map(rows_read, ledgers)), declared, "rows"))
            for table in tables.values():
                table.write()
        rows = {f"{table.name}.parquet": table.rows for table in tables.values()}
        if not any(rows.values()):
            raise empty_result("no topic yielded a row for a table", logs, selection)
        made = account(reading_of(ledgers))
        write_skipped(new, ledgers, made.reading, timeline=timeline)
        content = DecodeManifest(
            versions=versions(),
            tables={topic: f"{table.name}.parquet" for topic, table in tables.items()},
            rows=rows,
            settings=vehicle,
            account=made,
            time=time_segments(timeline),
        )
        write_manifest(new, content)
    return Decoded(run.path, rows, made, timeline, details_of(ledgers))


def _decoded(
    timed: TimedLog, vehicle: Vehicle, ledger: Ledger, selection: Selection
) -> Iterator[Block]:
    log = timed.log
    topics = {topic.name: topic for topic in log.topics}
    mobileye = _ros_mobileye(log, vehicle, ledger)
    decoders: dict[str, Decoder | None] = {}
    buses: dict[str, tuple[list[_BlockDecoder], list[MobileyeDecoder]]] = {}
    for block in ledger.handing_on(timed.read(ledger, selection)):
        # A topic may first be found while reading.
        topic = topics.get(block.topic) or next(t for t in log.topics if t.name == block.topic)
        if isinstance(block.rows, Messages):
            if block.topic not in decoders:
                decoders[block.topic] = _decoder(topic, ledger)
            decode = decoders[block.topic]
            if decode is None:
                reason = why_not_decoded(topic, "type not understood")
                ledger.skip(block.topic, reason, len(block))
                continue
            block = decode(block, ledger)
        if isinstance(block.rows, Table) and len(block):
            yield block
            if mobileye is not None:
                yield from mobileye(block)
        elif isinstance(block.rows, CanFrames):
            if block.topic not in buses:
                buses[block.topic] = _bus_decoders(block.topic, vehicle, ledger)
            of_bus, _ = buses[block.topic]
            if not of_bus:
                ledger.skip(block.topic, "no DBC file and no Mobileye for this bus", len(block))
            for on_bus in of_bus:
                yield from on_bus(block)
        elif isinstance(block.rows, Images):
            ledger.skip(block.topic, "pictures are not tables", len(block))
    for _, mobileyes in buses.values():
        for on_bus in mobileyes:
            yield from on_bus.flush()
    if mobileye is not None:
        yield from mobileye.flush()


def _ros_mobileye(log: Log, vehicle: Vehicle, ledger: Ledger) -> RosMobileye | None:
    """Return the decoder of ``mobileye_560_660_msgs``, or None if the log has no such messages."""
    types = {t.name: t.type_name for t in log.topics if role_of(t) is Role.MOBILEYE}
    if not types:
        return None
    return RosMobileye(
        "ros", types, ledger, mobileye_settings(vehicle.mobileye, is_shared_bus=False)
    )


def _decoder(topic: Topic, ledger: Ledger) -> Decoder | None:
    try:
        return decoder_for(topic)
    except SchemaError as error:
        ledger.notice(str(error))
        return None


def _bus_decoders(
    bus: str, vehicle: Vehicle, ledger: Ledger
) -> tuple[list[_BlockDecoder], list[MobileyeDecoder]]:
    decoders: list[_BlockDecoder] = []
    mobileyes: list[MobileyeDecoder] = []
    has_dbc = bool(vehicle.can.dbc) and vehicle.can.bus in (None, bus)
    settings = mobileye_settings(vehicle.mobileye, is_shared_bus=has_dbc)
    has_mobileye = vehicle.mobileye.bus == bus
    if has_dbc:
        from crosscue.replay.can.database import CanDatabase
        from crosscue.replay.can.decode import BusDecoder

        database = CanDatabase.load([Path(name) for name in vehicle.can.dbc])
        for sentence in database.notices:
            ledger.notice(sentence)
        elsewhere = all_ids(settings) if has_mobileye else ()
        decoders.append(BusDecoder(database, bus, ledger, elsewhere=elsewhere))
    if has_mobileye:
        mobileyes.append(MobileyeDecoder(bus, ledger, settings))
        decoders += mobileyes
    return decoders, mobileyes


def table_file(topic: str, taken: Collection[str]) -> str:
    """Return a file name without folders for a topic, different from the names already taken."""
    plain = "".join(c if c.isascii() and (c.isalnum() or c in "-.") else "_" for c in topic)
    plain = plain.strip("_.")[:100] or "topic"
    name, number = plain, 2
    while name.lower() in taken:
        name, number = f"{plain}-{number}", number + 1
    return name


def _labelled(
    columns: Mapping[str, NDArray[np.generic]], timeline: Timeline, clock: LogClock
) -> dict[str, NDArray[np.generic]]:
    """Return columns preceded by drive time, segment and the recorded stamps.

    A stream's own ``t_ns`` (the Mobileye's image time) is kept. Its other fields with one of these
    names get an underscore appended.
    """
    t_ns = np.asarray(columns["log_t_ns"], np.int64)
    log_t_ns = clock.log_times(t_ns)
    found: dict[str, NDArray[np.generic]] = {
        "t_ns": t_ns,
        "segment": timeline.numbers(t_ns),
        "log_t_ns": log_t_ns,
    }
    for name, values in columns.items():
        if name == "log_t_ns":
            continue
        if name == "publish_ns":
            values = np.asarray(values, np.int64) - (t_ns - log_t_ns)
        found[f"{name}_" if name == "segment" else name] = values
    return found
