"""Parser of the block structure of ASAM MDF 4 files, with checks of every link and size.

The library asammdf is not used because it trusts a damaged file's sizes and offsets: it allocates
terabytes, and reports a truncated data block as a shorter one.
"""

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import BinaryIO, Final

from crosscue.replay.errors import LogFormatError
from crosscue.replay.limits import Limits

_HEAD: Final = struct.Struct("<4s4xQQ")
HEAD_BYTES: Final = 24
_LINKS_MAX: Final = 100_000
_BLOCK_MAX: Final = 1 << 20
_TEXT_MAX: Final = 1 << 16
# Maximum number of blocks in a chain of links; a longer chain is circular.
_CHAIN_MAX: Final = 200_000
# Number of bytes read at once, because loggers write descriptive blocks close together.
_WINDOW: Final = 1 << 16
_TX: Final = re.compile(rb"<TX[^>]*>(.*?)</TX>", re.DOTALL)
_DATA: Final = (b"##DT", b"##SD", b"##RD")

VARIABLE, MASTER, VIRTUAL_MASTER, VIRTUAL, VARIABLE_COMPACT = 1, 2, 3, 6, 7
TIME: Final = 1
VLSD_GROUP: Final = 1
REMOTE_MASTER: Final = 8

CYCLE_COUNTERS: Final = 0x01
LAST_DATA_LENGTH: Final = 0x04
LAST_REDUCED_LENGTH: Final = 0x08
LAST_DATA_LIST: Final = 0x10
# Flags of an unfinalized file for the parts that the logger did not write.
VARIABLE_OFFSETS: Final = 0x40


class BrokenBlockError(Exception):
    """A block is outside the file or not of the kind that its link requires."""


@dataclass(frozen=True, slots=True)
class RawBlock:
    """A block: its offset, its links, and the bytes after them."""

    at: int
    links: tuple[int, ...]
    body: bytes


@dataclass(frozen=True, slots=True)
class Conversion:
    """Conversion from raw to physical values.

    Attributes:
        type: 0 none, 1 linear, 2 rational, 4 table with interpolation, 5 table, 6 table of ranges;
            others are not applied.
        values: Parameters of the conversion.
        unit: Unit of the physical value.
    """

    type: int = 0
    values: tuple[float, ...] = ()
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Mf4Channel:
    """A channel of a group; offsets count within the record, after the record identifier."""

    name: str
    type: int
    sync: int
    data_type: int
    bit_offset: int
    byte_offset: int
    bit_count: int
    flags: int
    invalid_bit: int
    data: int
    unit: str
    conversion: Conversion
    is_array: bool


@dataclass(frozen=True, slots=True)
class ChannelGroup:
    """A channel group.

    Attributes:
        name: Acquisition name, or the name of its source, or empty.
        record_id: Identifier before its records in unsorted data.
        records: Number of records that the file declares.
        flags: Bit 0: variable-length values; bit 1: bus traffic; bit 3: remote master.
        value_bytes: Number of value bytes of each record.
        invalid_bytes: Number of bytes with invalidation bits after the values.
        channels: All channels, including those of structures.
        at: Offset of its block, to which links refer.
    """

    name: str
    record_id: int
    records: int
    flags: int
    value_bytes: int
    invalid_bytes: int
    channels: tuple[Mf4Channel, ...]
    at: int = 0

    @property
    def record_bytes(self) -> int:
        """Size of each record in bytes, without its identifier."""
        return self.value_bytes + self.invalid_bytes


@dataclass(frozen=True, slots=True)
class DataGroup:
    """Groups whose records share a data stream."""

    id_bytes: int
    data: int
    groups: tuple[ChannelGroup, ...]


@dataclass(frozen=True, slots=True)
class StoredPart:
    """A stored part of a data stream.

    Attributes:
        start: Offset in the stream, which consists of all stretches of a data link.
        size: Size in the stream in bytes.
        at: Offset of its content in the file.
        stored: Size in the file in bytes.
        method: Compression method, as stored; -1 for none.
        parameter: Parameter of the method: number of columns of transposed records.
        damage: Reason why it cannot be read, or empty.
    """

    start: int
    size: int
    at: int
    stored: int
    method: int = -1
    parameter: int = 0
    damage: str = ""


@dataclass(frozen=True, slots=True)
class Header:
    """Identification and header block.

    Attributes:
        version: Version as stored, such as ``4.11``.
        is_finalized: True if the recorder wrote all counts and lengths.
        unfinished: Flags of the missing parts.
        start_ns: Start of the measurement.
        is_local: True if the start is in local time of an unknown zone.
        first_group: Link to the first data group.
    """

    version: str
    is_finalized: bool
    unfinished: int
    start_ns: int
    is_local: bool
    first_group: int


class Blocks:
    """Reads the blocks of an open file."""

    def __init__(
        self, file: BinaryIO, size: int, limits: Limits, note: Callable[[int, int], None]
    ) -> None:
        """Wrap ``file``; ``note`` is called with the start and size of every range read.

        The headers of data blocks are not noted, because all are read for any selection.
        """
        self._file, self.size, self._limits, self._note = file, size, limits, note
        self._linked: set[int] = set()
        self._window, self._window_at = b"", 0
        self._texts: dict[int, str] = {}

    def header(self, path: str) -> Header:
        """Read the identification and the header.

        Raises:
            LogFormatError: The file is not MDF 4, or its header is damaged.
        """
        self._file.seek(0)
        self._note(0, 64)
        head = self._file.read(64)
        name, version = head[:8], head[8:16].rstrip(b"\0 ").decode("ascii", "replace")
        if not head:
            raise LogFormatError(f"{path}: empty file; expected MDF 4, check how it was copied")
        if name not in (b"MDF     ", b"UnFinMF ") or len(head) < 64:
            raise LogFormatError(f"{path}: not an MDF file (starts with {name!r}); expected 'MDF'")
        if not version.startswith("4."):
            raise LogFormatError(f"{path}: MDF version {version!r}; expected 4.x, convert it first")
        try:
            block = self.block(64, b"##HD", 6, 24)
        except BrokenBlockError as broken:
            raise LogFormatError(f"{path}: MDF header damaged: {broken}") from None
        start_ns, _, _, time_flags = struct.unpack_from("<QhhB", block.body)
        if start_ns >= 1 << 62:
            raise LogFormatError(f"{path}: MDF header damaged: starts at {start_ns} ns, after 2115")
        is_finalized = name == b"MDF     "
        unfinished, custom = (0, 0) if is_finalized else struct.unpack_from("<HH", head, 60)
        if custom:
            # The meaning of a vendor's own flags is unknown, so no counter is trusted.
            unfinished |= CYCLE_COUNTERS | LAST_DATA_LENGTH
        is_local = bool(time_flags & 1)
        return Header(version, is_finalized, unfinished, start_ns, is_local, block.links[0])

    def block(self, at: int, kind: bytes, links: int, body: int) -> RawBlock:
        """Read the block at ``at``.

        Args:
            at: Byte offset.
            kind: Block type, such as ``##DG``.
            links: Minimum number of links.
            body: Minimum number of bytes after the links.

        Raises:
            BrokenBlockError: The block is missing, of another type, or too small.
        """
        found, length, count = self._head(at)
        if found != kind:
            raise BrokenBlockError(f"expected {kind.decode()} at byte {at}, found {found!r}")
        is_sound = links <= count <= _LINKS_MAX and HEAD_BYTES + 8 * count + body <= length
        if not is_sound or length > _BLOCK_MAX or at + length > self.size:
            raise BrokenBlockError(f"{kind.decode()} at byte {at} has impossible sizes")
        self._note(at, length)
        raw = self._near(at + HEAD_BYTES, length - HEAD_BYTES)
        found_links: tuple[int, ...] = struct.unpack_from(f"<{count}Q", raw)
        self._linked.update(found_links)
        return RawBlock(at, found_links, raw[8 * count :])

    def data_groups(self, first: int, unfinished: int) -> Iterator[DataGroup]:
        """Yield all data groups; the channels of empty groups are not read.

        Raises:
            BrokenBlockError: The chain is damaged from here on.
        """
        for block in self._chain(first, b"##DG", 4, 1):
            may_hold = bool(unfinished) or self._has_data(block.links[2])
            groups = tuple(
                self._group(one, may_hold) for one in self._chain(block.links[1], b"##CG", 6, 32)
            )
            yield DataGroup(block.body[0], block.links[2], groups)

    def stretches(self, link: int, unfinished: int) -> Iterator[StoredPart]:
        """Yield the stretches of a data link in order, by reading only their headers.

        Args:
            link: Link to a data block or a list of data blocks.
            unfinished: The file's flags of missing parts.

        Raises:
            BrokenBlockError: The chain of blocks is damaged from here on.
        """
        start, addresses = 0, iter(self._data_blocks(link, unfinished))
        at = next(addresses, None)
        while at is not None:
            # The blocks before a broken link are yielded before the error is raised.
            try:
                after, error = next(addresses, None), None
            except BrokenBlockError as broken:
                after, error = None, broken
            is_last = after is None and error is None
            is_open = is_last and bool(unfinished & (LAST_DATA_LENGTH | LAST_REDUCED_LENGTH))
            for stretch in self._stretch(at, start, is_open):
                yield stretch
                start = stretch.start + stretch.size
            if error is not None:
                raise error
            at = after

    def read(self, at: int, count: int) -> bytes:
        """Read bytes of the file."""
        self._note(at, count)
        self._file.seek(at)
        return self._file.read(count)

    def _data_blocks(self, at: int, unfinished: int) -> Iterator[int]:
        if not at:
            return
        kind, _, _ = self._head(at)
        if kind == b"##HL":
            at = self.block(at, kind, 1, 0).links[0]
            if not at:
                return
            kind, _, _ = self._head(at)
        if kind != b"##DL":
            yield at
            return
        for block in self._chain(at, b"##DL", 1, 0):
            found = [link for link in block.links[1:] if link]
            yield from found
            if not block.links[0] and unfinished & LAST_DATA_LIST:
                missing = len(block.links) - 1 - len(found)
                yield from self._unlinked(found[-1] if found else block.at, missing)

    def _unlinked(self, at: int, count: int) -> Iterator[int]:
        """Yield data blocks after the one at ``at`` that are missing in their list."""
        for _ in range(count):
            at = -(-(at + self._head(at)[1]) // 8) * 8
            if at + HEAD_BYTES > self.size or self._head(at)[0] not in (*_DATA, b"##DZ"):
                return
            yield at

    def _stretch(self, at: int, start: int, is_open: bool) -> Iterator[StoredPart]:
        kind, length, count = self._head(at)
        if kind == b"##DZ":
            yield self._compressed(at, start)
            return
        if kind not in _DATA or length < HEAD_BYTES or count:
            raise BrokenBlockError(f"no data block at byte {at}: {kind!r}")
        content = at + HEAD_BYTES
        end = self._following(at) if is_open else at + length
        there = max(min(end, self.size) - content, 0)
        if there:
            yield StoredPart(start, there, content, there)
        if content + there < end:
            damage = f"data block at byte {at} is cut by the file's end"
            yield StoredPart(start + there, end - content - there, content, 0, damage=damage)

    def _following(self, at: int) -> int:
        """Return the start of the next linked block, or the file's end."""
        return min((link for link in self._linked if link > at), default=self.size)

    def _compressed(self, at: int, start: int) -> StoredPart:
        _, length, _ = self._head(at)
        head = self._near(at + HEAD_BYTES, 24)
        if len(head) < 24:
            raise BrokenBlockError(f"compressed block at byte {at} is cut by the file's end")
        method, parameter, original, stored = struct.unpack_from("<2xBxLQQ", head)
        limit = self._limits.chunk_bytes
        if max(original, stored) > limit:
            raise BrokenBlockError(
                f"compressed block at byte {at} declares {max(original, stored)} bytes, the limit "
                f"is {limit} (--max-chunk)"
            )
        if length < HEAD_BYTES + 24 + stored:
            raise BrokenBlockError(f"compressed block at byte {at} has impossible sizes")
        return StoredPart(start, original, at + HEAD_BYTES + 24, stored, method, parameter)

    def _head(self, at: int) -> tuple[bytes, int, int]:
        if at % 2 or at + HEAD_BYTES > self.size:
            raise BrokenBlockError(f"a link leads to byte {at}, outside the file")
        kind, length, count = _HEAD.unpack(self._near(at, HEAD_BYTES))
        return kind, length, count

    def _near(self, at: int, count: int) -> bytes:
        """Read bytes through a window, because descriptive blocks are close together."""
        start = at - self._window_at
        if start < 0 or start + count > len(self._window):
            start = at % _WINDOW
            self._window_at = self._file.seek(at - start)
            self._window = self._file.read(max(start + count, _WINDOW))
        return self._window[start : start + count]

    def _chain(self, at: int, kind: bytes, links: int, body: int) -> Iterator[RawBlock]:
        seen: set[int] = set()
        while at:
            if at in seen or len(seen) > _CHAIN_MAX:
                raise BrokenBlockError(f"{kind.decode()} blocks form a circle at byte {at}")
            seen.add(at)
            block = self.block(at, kind, links, body)
            yield block
            at = block.links[0]

    def _has_data(self, link: int) -> bool:
        """Return whether a link has data; the data blocks of unused frame kinds are empty."""
        if not link:
            return False
        try:
            kind, length, _ = self._head(link)
        except BrokenBlockError:
            return True  # reading the data reports the damage
        return kind not in _DATA or length != HEAD_BYTES

    def _group(self, block: RawBlock, may_hold: bool) -> ChannelGroup:
        record_id, records, flags, _, value_bytes, invalid_bytes = struct.unpack_from(
            "<QQHH4xLL", block.body
        )
        if value_bytes + invalid_bytes > self._limits.message_bytes:
            raise BrokenBlockError(
                f"##CG at byte {block.at} declares records of {value_bytes} bytes"
            )
        name = self._text(block.links[2]) or self._source(block.links[3])
        is_needed = may_hold or records or not value_bytes
        channels = tuple(self._channels(block.links[1], depth=0)) if is_needed else ()
        return ChannelGroup(
            name, record_id, records, flags, value_bytes, invalid_bytes, channels, block.at
        )

    def _channels(self, first: int, depth: int) -> Iterator[Mf4Channel]:
        for block in self._chain(first, b"##CN", 8, 24):
            links = block.links
            type_, sync, data_type, bit_offset, byte_offset, bits, flags, invalid = (
                struct.unpack_from("<BBBBLLLL", block.body)
            )
            part_kind = self._head(links[1])[0] if links[1] else b""
            conversion = self._conversion(links[4])
            yield Mf4Channel(
                self._text(links[2]),
                type_,
                sync,
                data_type,
                bit_offset,
                byte_offset,
                bits,
                flags,
                invalid,
                links[5],
                self._text(links[6]) or conversion.unit,
                conversion,
                part_kind == b"##CA",
            )
            if part_kind == b"##CN" and depth < 4:
                yield from self._channels(links[1], depth + 1)

    def _conversion(self, at: int) -> Conversion:
        if not at:
            return Conversion()
        block = self.block(at, b"##CC", 4, 24)
        type_, _, _, _, count = struct.unpack_from("<BBHHH", block.body)
        if len(block.body) < 24 + 8 * count:
            raise BrokenBlockError(f"##CC at byte {at} has impossible sizes")
        values = struct.unpack_from(f"<{count}d", block.body, 24)
        return Conversion(type_, values, self._text(block.links[1]))

    def _source(self, at: int) -> str:
        if not at:
            return ""
        block = self.block(at, b"##SI", 3, 0)
        return self._text(block.links[0]) or self._text(block.links[1])

    def _text(self, at: int) -> str:
        """Return the text of a text block or of an XML block, without an XML parser."""
        if not at:
            return ""
        if at not in self._texts:
            self._texts[at] = self._read_text(at)
        return self._texts[at]

    def _read_text(self, at: int) -> str:
        kind, length, count = self._head(at)
        if kind not in (b"##TX", b"##MD") or length < HEAD_BYTES or count:
            raise BrokenBlockError(f"no text block at byte {at}: {kind!r}")
        self._note(at, min(length, _TEXT_MAX))
        raw = self._near(at + HEAD_BYTES, min(length - HEAD_BYTES, _TEXT_MAX)).split(b"\0", 1)[0]
        if kind == b"##MD":
            found = _TX.search(raw)
            raw = found[1] if found else b""
        return raw.decode("utf-8", "replace").strip()
