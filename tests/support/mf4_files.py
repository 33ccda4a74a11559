"""MDF 4 bus logs written block by block, as unsorted and unfinalized logs of data loggers are."""

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from crosscue.replay.columns import DATA, ERROR, REMOTE

from .can_files import FD_LENGTHS, START_NS, Sent

KINDS = {DATA: "CAN_DataFrame", REMOTE: "CAN_RemoteFrame", ERROR: "CAN_ErrorFrame"}
VALUE, VARIABLE, MASTER, VIRTUAL = 0, 1, 2, 6
UNSIGNED, REAL, BYTES = 0, 4, 10


class Blocks:
    """A file under construction, in which children precede their parents."""

    def __init__(self, *, is_finalized: bool, flags: int) -> None:
        name = b"MDF     " if is_finalized else b"UnFinMF "
        head = name + b"4.11    test    " + bytes(4) + struct.pack("<H", 411) + bytes(30)
        self.content = bytearray(head + struct.pack("<HH", flags, 0))
        self.add(b"##HD", [0] * 6, struct.pack("<QhhBBBxdd", START_NS, 0, 0, 0, 0, 0, 0.0, 0.0))

    def add(self, kind: bytes, links: Sequence[int], body: bytes) -> int:
        """Write one block, and return its offset."""
        self.content += bytes(-len(self.content) % 8)
        at = len(self.content)
        size = 24 + 8 * len(links) + len(body)
        self.content += struct.pack("<4s4xQQ", kind, size, len(links))
        self.content += struct.pack(f"<{len(links)}Q", *links) + body
        return at

    def link(self, at: int, which: int, target: int) -> None:
        """Set a link of a block that was written before its target."""
        struct.pack_into("<Q", self.content, at + 24 + 8 * which, target)

    def text(self, text: str) -> int:
        """Write a text block."""
        raw = text.encode() + b"\0"
        return self.add(b"##TX", [], raw + bytes(-len(raw) % 8))

    def conversion(self, type_: int, values: Sequence[float]) -> int:
        """Write a conversion of any type without texts."""
        body = struct.pack("<BBHHHdd", type_, 0, 0, 0, len(values), 0.0, 0.0)
        return self.add(b"##CC", [0] * 4, body + struct.pack(f"<{len(values)}d", *values))


@dataclass(frozen=True, slots=True)
class Field:
    """One channel; bit positions are relative to the end of the record's identifier."""

    name: str
    byte: int = 0
    bits: int = 0
    bit: int = 0
    type: int = VALUE
    data_type: int = UNSIGNED
    conversion: tuple[int, tuple[float, ...]] | None = None
    data: int = 0


def constant(name: str, value: float) -> Field:
    """A virtual channel, whose value is stored in its conversion instead of the record."""
    return Field(name, type=VIRTUAL, conversion=(1, (value, 0.0)))


@dataclass(slots=True)
class Made:
    """One channel group and its records.

    Attributes:
        name: Acquisition name.
        size: Bytes of each record.
        fields: Its channels.
        encode: Function from a frame and the offset of its payload to its record.
        identifier: Record identifier in unsorted data.
        values: Identifier of the group with its payloads, None without one.
    """

    name: str
    size: int
    fields: list[Field]
    encode: Callable[[Sent, int], bytes]
    identifier: int = 0
    values: int | None = None
    count: int = field(default=0, init=False)
    stored: int = field(default=0, init=False)


def channels(blocks: Blocks, fields: Sequence[Field]) -> int:
    """Write a chain of channels, and return the link to the first one."""
    following = 0
    for one in reversed(fields):
        conversion = blocks.conversion(*one.conversion) if one.conversion else 0
        name = blocks.text(one.name)
        body = struct.pack(
            "<BBBBLL60x",
            *(one.type, int(one.type == MASTER), one.data_type, one.bit, one.byte, one.bits),
        )
        following = blocks.add(b"##CN", [following, 0, name, 0, conversion, one.data, 0, 0], body)
    return following


def one_group() -> Made:
    """The group of older CANedge firmware, with payloads of variable length."""
    prefix = "CAN_DataFrame."

    def encode(frame: Sent, offset: int) -> bytes:
        ticks = float(frame.t_ns - START_NS)
        word = int(frame.is_extended) | int(frame.bus) << 1 | frame.arbitration_id << 3
        code = FD_LENGTHS.index(len(frame.payload))
        rest = len(frame.payload) << 1 | code << 12 | int(frame.is_fd) << 8
        return struct.pack("<dLHQ", ticks, word, rest, offset)

    fields = [
        Field("Timestamp", 0, 64, type=MASTER, data_type=REAL, conversion=(1, (0.0, 1e-9))),
        Field("CAN_DataFrame", 8, 112, data_type=BYTES),
        Field(prefix + "BusChannel", 8, 2, 1),
        Field(prefix + "ID", 8, 29, 3),
        Field(prefix + "IDE", 8, 1, 0),
        Field(prefix + "DLC", 13, 4, 4),
        Field(prefix + "DataLength", 12, 7, 1),
        Field(prefix + "DataBytes", 14, 64, type=VARIABLE, data_type=BYTES),
        Field(prefix + "Dir", 12, 1, 0),
        Field(prefix + "EDL", 13, 1, 0),
    ]
    return Made("CAN_DataFrame", 22, fields, encode)


def virtual_group(bus: int, kind: int, *, is_extended: bool, is_fd: bool, is_long: bool) -> Made:
    """A group of newer CANedge firmware, which has one for each bus and kind of frame.

    Bus, kind of identifier, direction and CAN FD are virtual channels. The payload's length is a
    table conversion of its code.
    """
    prefix = f"{KINDS[kind]}."
    width = 4 if is_extended else 2
    payload_bytes = 0 if kind == REMOTE else 4 if is_long else 8

    def encode(frame: Sent, offset: int) -> bytes:
        ticks = (frame.t_ns - START_NS) // 1000
        code = FD_LENGTHS.index(len(frame.payload))
        head = struct.pack("<Q", ticks)[:6] + struct.pack("<L", frame.arbitration_id)[:width]
        payload = (
            struct.pack("<L", offset) if is_long else frame.payload.ljust(payload_bytes, b"\0")
        )
        return head + bytes([code]) + payload[:payload_bytes]

    table = tuple(float(x) for pair in enumerate(FD_LENGTHS) for x in pair)
    fields = [
        Field("Timestamp", 0, 48, type=MASTER, conversion=(1, (0.0, 1e-6))),
        Field(prefix[:-1], 6, 8 * (width + 1 + payload_bytes), data_type=BYTES),
        constant(prefix + "BusChannel", bus),
        Field(prefix + "ID", 6, 29 if is_extended else 11),
        constant(prefix + "IDE", int(is_extended)),
        Field(prefix + "DLC", 6 + width, 4),
        Field(prefix + "DataLength", 6 + width, 4, conversion=(5, table)),
        constant(prefix + "Dir", bus % 2),
        constant(prefix + "EDL", int(is_fd)),
    ]
    if payload_bytes:
        type_ = VARIABLE if is_long else VALUE
        fields.append(Field(prefix + "DataBytes", 7 + width, 8 * payload_bytes, 0, type_, BYTES))
    name = f"CAN{bus}{'_RTR' * (kind == REMOTE)}{'_IDE' * is_extended}{'_FD' * is_fd}"
    return Made(name, 7 + width + payload_bytes, fields, encode)


@dataclass(frozen=True, slots=True)
class Unsorted:
    """An unsorted log.

    Attributes:
        content: Bytes of the file.
        data_at: Offset of the data.
        ends: For each frame, the end of its last byte in the file.
        starts: Start of each record in the file, and the end of the last one.
    """

    content: bytes
    data_at: int
    ends: list[int]
    starts: list[int]


def unsorted(
    frames: Sequence[Sent],
    *,
    virtual: bool,
    id_bytes: int = 1,
    order: str = "after",
    flags: int = 0x25,
    is_finalized: bool = False,
    stretch: int = 0,
    coding: int = -1,
) -> Unsorted:
    """Write frames of several groups in one unsorted data section.

    Args:
        frames: Frames to write.
        virtual: Use groups of newer CANedge firmware instead of older.
        id_bytes: Size of each record's identifier.
        order: Payloads of variable length are ``after`` or ``before`` their record, or ``last``.
        flags: Finalization steps that the logger has not done.
        is_finalized: All counters are written.
        stretch: Bytes in each data block of a list; 0 for one block.
        coding: Compression of those blocks: -1 none, 0 deflate, 1 transposition and deflate.
    """
    groups: dict[object, Made] = {}
    data, late, later = bytearray(), bytearray(), []
    ends: list[int] = []
    starts: list[int] = []
    for frame in frames:
        group = _group_of(groups, frame, virtual)
        head = group.identifier.to_bytes(id_bytes, "little")
        by_order = bool(flags & 0x40)
        record = head + group.encode(frame, 0xFFFF if by_order else group.stored)
        value = b""
        if group.values is not None:
            value = group.values.to_bytes(id_bytes, "little")
            value += struct.pack("<L", len(frame.payload)) + frame.payload
            group.stored += 4 + len(frame.payload)
        group.count += 1
        pieces = [value, record] if order == "before" else [record, value]
        if order == "last":
            pieces = [record]
            later.append((len(ends), len(late), len(late) + len(value)))
            late += value
        for piece in pieces:
            if piece:
                starts.append(len(data))
                data += piece
        ends.append(len(data))
    for k, begin, end in later:
        if end > begin:
            starts.append(len(data) + begin)
            ends[k] = len(data) + end
    data += late
    blocks = Blocks(is_finalized=is_finalized, flags=0 if is_finalized else flags)
    _describe(blocks, list(groups.values()), id_bytes, is_finalized=is_finalized)
    at = _store(blocks, bytes(data), stretch, coding, flags, is_finalized)
    blocks.link(_first_group(blocks), 2, at)
    begin = at + 24
    return Unsorted(
        bytes(blocks.content),
        begin,
        [begin + end for end in ends],
        [begin + start for start in (*starts, len(data))],
    )


def _group_of(groups: dict[object, Made], frame: Sent, virtual: bool) -> Made:
    is_long = len(frame.payload) > 8
    key: object = 0
    if virtual:
        key = (frame.bus, frame.kind, frame.is_extended, frame.is_fd, is_long)
    if key not in groups:
        made = one_group()
        if virtual:
            made = virtual_group(
                int(frame.bus),
                frame.kind,
                is_extended=frame.is_extended,
                is_fd=frame.is_fd,
                is_long=is_long,
            )
        made.identifier = 10 + 2 * len(groups)
        if not virtual or is_long:
            made.values = made.identifier + 1
        groups[key] = made
    return groups[key]


def _describe(blocks: Blocks, groups: Sequence[Made], id_bytes: int, *, is_finalized: bool) -> None:
    following = 0
    for group in groups:
        fields = group.fields
        if group.values is not None:
            count, stored = (group.count, group.stored) if is_finalized else (0, 0)
            body = struct.pack("<QQHH4xLL", group.values, count, 1, 0, stored, 0)
            following = blocks.add(b"##CG", [following, 0, 0, 0, 0, 0], body)
            fields = [
                Field(f.name, f.byte, f.bits, f.bit, f.type, f.data_type, None, following)
                if f.type == VARIABLE
                else f
                for f in fields
            ]
        following = _channel_group(blocks, group, fields, following, is_finalized)
    at = blocks.add(b"##DG", [0, following, 0, 0], struct.pack("<B7x", id_bytes))
    blocks.link(64, 0, at)


def _channel_group(
    blocks: Blocks, group: Made, fields: Sequence[Field], following: int, is_finalized: bool
) -> int:
    first = channels(blocks, fields)
    name = blocks.text(group.name)
    source = blocks.add(b"##SI", [name, 0, 0], struct.pack("<BBB5x", 2, 2, 0))
    count = group.count if is_finalized else 0
    body = struct.pack("<QQHH4xLL", group.identifier, count, 6, 0, group.size, 0)
    return blocks.add(b"##CG", [following, first, name, source, 0, 0], body)


def _first_group(blocks: Blocks) -> int:
    at: int = struct.unpack_from("<Q", blocks.content, 64 + 24)[0]
    return at


def _store(
    blocks: Blocks, data: bytes, stretch: int, coding: int, flags: int, is_finalized: bool
) -> int:
    if not stretch:
        at = blocks.add(b"##DT", [], data)
        if not is_finalized and flags & 0x04:
            struct.pack_into("<Q", blocks.content, at + 8, 24)
        return at
    parts = [data[k : k + stretch] for k in range(0, len(data), stretch)]
    at = 0
    if coding >= 0:
        at = blocks.add(b"##HL", [0], struct.pack("<HB5x", 1, coding))
    body = struct.pack("<B3xLQ", 1, len(parts), stretch)
    listed = blocks.add(b"##DL", [0] * (1 + len(parts)), body)
    if at:
        blocks.link(at, 0, listed)
    for k, part in enumerate(parts):
        one = blocks.add(b"##DZ", [], deflated(part, coding)) if coding >= 0 else 0
        one = one or blocks.add(b"##DT", [], part)
        # An interrupted logger has not listed its last blocks.
        if is_finalized or not flags & 0x10 or k < len(parts) // 2:
            blocks.link(listed, 1 + k, one)
    return at or listed


def deflated(part: bytes, coding: int) -> bytes:
    """The body of a compressed block; transposition is of 20 columns."""
    original, columns = part, 20
    if coding == 1:
        rows = len(part) // columns
        transposed = b"".join(part[c : rows * columns : columns] for c in range(columns))
        part = transposed + part[rows * columns :]
    packed = zlib.compress(part)
    parameter = columns if coding == 1 else 0
    head = struct.pack("<2sBxLQQ", b"DT", coding, parameter, len(original), len(packed))
    return head + packed
