"""Small ROS bags of known content, damaged copies of them, and a comparison of readings."""

import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import lz4.frame
import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from crosscue.replay.base import EVERYTHING, Log, Selection
from crosscue.replay.errors import CrosscueError
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log

START_NS: Final = 1_700_000_000_000_000_000


@dataclass(frozen=True, slots=True)
class Row:
    """One message, as written or read."""

    topic: str
    log_ns: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Reading:
    """Result of reading a log once."""

    rows: tuple[Row, ...]
    ledger: Ledger
    log: Log


# Name, type and payload bytes of the topics in the made-up bags.
TOPICS: Final = (
    ("/imu/data", "sensor_msgs/msg/Imu", 120),
    ("/can", "std_msgs/msg/String", 24),
    ("/camera/image", "sensor_msgs/msg/CompressedImage", 900),
    ("/gps/fix", "sensor_msgs/msg/NavSatFix", 60),
)


def rows_of(
    count: int, seed: int = 7, topics: Sequence[tuple[str, str, int]] = TOPICS
) -> list[Row]:
    """Generate ``count`` messages of random bytes in time order, most of them on ``/can``."""
    rng = np.random.default_rng(seed)
    which = rng.choice(len(topics), size=count, p=np.array([2, 6, 1, 1]) / 10)
    steps = rng.integers(1, 2_000_000, size=count)
    times = START_NS + np.cumsum(steps)
    made = []
    for i, topic in enumerate(which):
        name, _, size = topics[topic]
        # ROS 2 payloads begin with the CDR header; to ROS 1 readers it is data.
        body = rng.integers(0, 256, size=size - 4 + int(rng.integers(0, 9)), dtype=np.uint8)
        made.append(Row(name, int(times[i]), b"\x00\x01\x00\x00" + body.tobytes()))
    return made


def write_bag(
    path: Path, rows: Sequence[Row], compression: str = "none", chunk_bytes: int = 8192
) -> Path:
    """Write a ROS 1 bag of ``rows`` with rosbags."""
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Writer1(path)
    if compression == "lz4 checked":
        # The ROS recorder writes a content checksum into its lz4 frames; rosbags does not.
        writer.compression_format = "lz4"
        writer.compressor = lambda raw: bytes(lz4.frame.compress(raw, content_checksum=True))
    elif compression != "none":
        writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    writer.chunk_threshold = chunk_bytes
    _write_rows(writer, rows, store)
    return path


def _write_rows(writer: Writer1 | Writer2, rows: Sequence[Row], store: Typestore) -> None:
    with writer:
        links: dict[str, Connection] = {}
        for row in rows:
            if row.topic not in links:
                type_name = next(t for name, t, _ in TOPICS if name == row.topic)
                links[row.topic] = writer.add_connection(row.topic, type_name, typestore=store)
            writer.write(links[row.topic], row.log_ns, row.payload)


def unclosed(bag: bytes) -> bytes:
    """Return the bag as a killed recorder leaves it, without index section or its position."""
    at = bag.index(b"index_pos=") + len(b"index_pos=")
    index_at = int.from_bytes(bag[at : at + 8], "little")
    return bag[:at] + bytes(8) + bag[at + 8 : index_at]


def write_folder(
    path: Path,
    rows: Sequence[Row],
    storage: Literal["sqlite3", "mcap"] = "sqlite3",
    compression: Literal["none", "file", "message"] = "none",
) -> Path:
    """Write a ROS 2 bag folder of ``rows`` with rosbags."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Writer2(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if compression != "none":
        writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    _write_rows(writer, rows, store)
    return path


def read_rows(path: Path, selection: Selection = EVERYTHING) -> Reading:
    """Read all rows of ``path`` with our reader."""
    ledger = Ledger(str(path))
    rows: list[Row] = []
    with open_log(path) as log:
        for block in log.read(ledger, selection):
            for i in range(len(block)):
                payload = bytes(block.rows.payload(i))  # type: ignore[union-attr]
                rows.append(Row(block.topic, int(block.log_ns[i]), payload))
    return Reading(tuple(rows), ledger, log)


def by_topic(rows: Sequence[Row]) -> dict[str, list[Row]]:
    sorted_rows: dict[str, list[Row]] = {}
    for row in rows:
        sorted_rows.setdefault(row.topic, []).append(row)
    return sorted_rows


Verdict = Literal[
    "refused", "same", "reported", "wrong, reported", "undetectable", "SILENT LOSS", "SILENT WRONG"
]


def judge(path: Path, truth: Sequence[Row], calm: frozenset[str] = frozenset()) -> Verdict:
    """Compare a damaged copy with the rows and notices of the undamaged file."""
    try:
        reading = read_rows(path)
    except CrosscueError:
        return "refused"
    ledger = reading.ledger
    _check_identity(ledger, reading.rows)
    was_reported = not ledger.is_whole or bool(set(ledger.notices) - calm)
    was_reported = was_reported or any(account.skipped for account in ledger.accounts.values())
    if by_topic(reading.rows) == by_topic(truth):
        return "same"
    unexpected = Counter(reading.rows) - Counter(truth)
    if not unexpected:
        return "reported" if was_reported else "SILENT LOSS"
    if _only_payloads_differ(reading.rows, truth, unexpected, path.suffix == ".db3"):
        assert "cannot be detected" in ledger.integrity
        return "undetectable"
    return "wrong, reported" if was_reported else "SILENT WRONG"


def _only_payloads_differ(
    rows: Sequence[Row], truth: Sequence[Row], unexpected: Counter[Row], is_sqlite: bool
) -> bool:
    """Return whether every unexpected row replaces a missing one.

    A bag stores topic, time and length in record headers and in its index, so they must be equal.
    SQLite stores topic number and payload length only once, so only the time must be equal.
    """

    def place(row: Row) -> tuple[str, int, int]:
        return ("", row.log_ns, 0) if is_sqlite else (row.topic, row.log_ns, len(row.payload))

    missing = Counter(truth) - Counter(rows)
    return not Counter(map(place, unexpected.elements())) - Counter(map(place, missing.elements()))


def _check_identity(ledger: Ledger, rows: Sequence[Row]) -> None:
    """Check that rows in the file are used, skipped or dropped, and used rows were returned."""
    returned = Counter(row.topic for row in rows)
    for name, account in ledger.accounts.items():
        assert account.used == returned.get(name, 0), (name, account)
        assert account.in_file == account.used + account.skipped.total() + account.dropped.total()
    assert not returned.keys() - ledger.accounts.keys()


def damaged_copies(intact: bytes, cuts: int, flips: int, seed: int) -> Iterator[tuple[str, bytes]]:
    """Yield damaged copies with a description; the seed determines all."""
    rng = np.random.default_rng(seed)
    for at in rng.integers(0, len(intact), size=cuts):
        yield f"cut at {at}", intact[: int(at)]
    for _ in range(flips):
        length = int(rng.choice([1, 1, 2, 4, 8, 16, 32, 64]))
        at = int(rng.integers(0, max(1, len(intact) - length)))
        kind = ("noise", "zeros", "bit")[int(rng.integers(0, 3))]
        copy = bytearray(intact)
        if kind == "bit":
            copy[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == "zeros":
            copy[at : at + length] = bytes(length)
        else:
            copy[at : at + length] = rng.integers(0, 256, size=length, dtype=np.uint8).tobytes()
        yield f"{kind} {length} at {at}", bytes(copy)


def faults(
    path: Path,
    truth: Sequence[Row],
    seed: int,
    calm: frozenset[str] = frozenset(),
    forbidden: tuple[str, ...] = ("SILENT",),
) -> list[tuple[str, Verdict]]:
    """Judge 60 cut and 140 damaged copies of a file; return those with a forbidden verdict."""
    judged = []
    for how, copy in damaged_copies(path.read_bytes(), cuts=60, flips=140, seed=seed):
        path.write_bytes(copy)
        judged.append((how, judge(path, truth, calm)))
    return [one for one in judged if one[1].startswith(forbidden)]


def header_field(name: bytes, value: bytes) -> bytes:
    return struct.pack("<I", len(name) + 1 + len(value)) + name + b"=" + value


def record(body: bytes, **fields: bytes) -> bytes:
    header = b"".join(header_field(name.encode(), value) for name, value in fields.items())
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(body)) + body


def u32(value: int) -> bytes:
    return struct.pack("<I", value)


def stamp(t_ns: int) -> bytes:
    """A time, as records store it."""
    return struct.pack("<II", t_ns // 10**9, t_ns % 10**9)


def connection(conn: int, topic: bytes, type_name: bytes = b"std_msgs/String") -> bytes:
    body = b"".join(
        header_field(name, value)
        for name, value in (
            (b"topic", topic),
            (b"type", type_name),
            (b"md5sum", type_name * 2),
            (b"message_definition", b"string data\n"),
        )
    )
    return record(body, op=b"\x07", conn=u32(conn), topic=topic)


def message(conn: int, t_ns: int, payload: bytes) -> bytes:
    return record(payload, op=b"\x02", conn=u32(conn), time=stamp(t_ns))


def chunk(body: bytes, compression: bytes = b"none", size: int | None = None) -> bytes:
    """A chunk record that declares ``size`` bytes, or as many as ``body`` has."""
    declared = len(body) if size is None else size
    return record(body, op=b"\x05", compression=compression, size=u32(declared))


def bag(path: Path, *records: bytes, **header: bytes) -> Path:
    """Write a bag of these records, with fields of its header other than those of no index."""
    fields = {"op": b"\x03", "index_pos": bytes(8), "conn_count": u32(0), "chunk_count": u32(0)}
    path.write_bytes(b"#ROSBAG V2.0\n" + record(b" " * 64, **(fields | header)) + b"".join(records))
    return path
