"""Read Cap'n Proto messages: framing, structs and lists, by the byte positions of the encoding.

A stream is a sequence of messages, each with a table of its segments. Nothing is copied but what is
asked for; every pointer is checked, so that damaged bytes raise ``MessageError`` and never reach
outside their message. Positions of fields are those that the encoding assigns to a schema.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

WORD: Final = 8
# The reference implementation accepts as many.
SEGMENTS_MAX: Final = 512
_STRUCT, _LIST, _FAR = 0, 1, 2
_BITS_OF_ELEMENT: Final = (0, 1, 8, 16, 32, 64)
_COMPOSITE: Final = 7


class MessageError(Exception):
    """The bytes are not a message."""


def messages(
    read: Callable[[int], bytes], limit_bytes: int
) -> Iterator[tuple[bytes, tuple[int, ...]]]:
    """Yield the bytes of each message behind its table, and the offsets of its segments.

    Raises:
        MessageError: The file ends within a message, or what follows is not a message.
    """
    place = 0
    while head := read(4):
        count = struct.unpack("<I", head)[0] + 1 if len(head) == 4 else 0
        if not 0 < count <= SEGMENTS_MAX:
            raise MessageError(f"byte {place}: no table of segments")
        # The table is padded to whole words.
        table = read(4 * (count + 1 - count % 2))
        if len(table) < 4 * count:
            raise MessageError(f"byte {place}: cut in the table of segments")
        sizes = struct.unpack_from(f"<{count}I", table)
        size = WORD * sum(sizes)
        if size > limit_bytes:
            raise MessageError(f"byte {place}: a message of {size} bytes, limit {limit_bytes}")
        body = read(size)
        if len(body) < size:
            raise MessageError(f"byte {place}: cut in a message of {size} bytes")
        place += len(head) + len(table) + size
        yield body, (*(WORD * sum(sizes[:i]) for i in range(count)), size)


@dataclass(frozen=True, slots=True)
class _Message:
    """Bytes of a message, and the offsets of its segments, the last being its end."""

    body: bytes
    edges: tuple[int, ...]

    def pointer(self, segment: int, at: int) -> tuple[int, int, int]:
        """Return a pointer with the segment and the offset that its target is counted from."""
        value = self._word(segment, at)
        if value & 3 != _FAR:
            return value, segment, at + WORD
        segment, at = value >> 32, WORD * ((value >> 3) & 0x1FFFFFFF)
        if segment >= len(self.edges) - 1:
            raise MessageError("a pointer to a missing segment")
        at += self.edges[segment]
        if not value & 4:
            value = self._word(segment, at)
            if value & 3 == _FAR:
                raise MessageError("a far pointer to a far pointer")
            return value, segment, at + WORD
        # Two words: where the content begins, and its kind and size, with offset 0.
        far, tag = self._word(segment, at), self._word(segment, at + WORD)
        segment = far >> 32
        if far & 3 != _FAR or segment >= len(self.edges) - 1:
            raise MessageError("a far pointer to a missing segment")
        return tag, segment, self.edges[segment] + WORD * ((far >> 3) & 0x1FFFFFFF)

    def checked(self, segment: int, start: int, size: int) -> int:
        """Return an offset if that many bytes are in the segment."""
        if not self.edges[segment] <= start <= start + size <= self.edges[segment + 1]:
            raise MessageError("a pointer out of its segment")
        return start

    def _word(self, segment: int, at: int) -> int:
        found: int = struct.unpack_from("<Q", self.body, self.checked(segment, at, WORD))[0]
        return found


def _target(value: int, base: int) -> int:
    """Return the offset of a pointer's target; its 30-bit offset has a sign."""
    offset = (value & 0xFFFFFFFF) >> 2
    return base + WORD * (offset - (1 << 30) if offset >> 29 else offset)


@dataclass(frozen=True, slots=True)
class Struct:
    """A struct of a message: data fields by byte offset, pointers by index."""

    message: _Message
    segment: int
    data: int
    data_bytes: int
    pointers: int

    @classmethod
    def root(cls, body: bytes, edges: tuple[int, ...]) -> Struct:
        """Return the struct at the beginning of a message."""
        return cls._at(_Message(body, edges), 0, 0)

    @classmethod
    def _at(cls, message: _Message, segment: int, at: int) -> Struct:
        value, segment, base = message.pointer(segment, at)
        if value == 0:
            return cls(message, segment, base, 0, 0)
        if value & 3 != _STRUCT:
            raise MessageError("expected a struct")
        data_bytes, pointers = WORD * ((value >> 32) & 0xFFFF), value >> 48
        start = message.checked(segment, _target(value, base), data_bytes + WORD * pointers)
        return cls(message, segment, start, data_bytes, pointers)

    def number(self, code: str, at: int) -> int | float:
        """Return a number by its ``struct`` code and byte offset; 0 if the writer had none."""
        if at + struct.calcsize(code) > self.data_bytes:
            return 0
        found: int | float = struct.unpack_from(f"<{code}", self.message.body, self.data + at)[0]
        return found

    def flag(self, bit: int) -> bool:
        """Return a flag by its bit."""
        return bool(int(self.number("B", bit // 8)) >> bit % 8 & 1)

    def struct(self, index: int) -> Struct:
        """Return the struct of a pointer, without fields if it is null."""
        if index >= self.pointers:
            return Struct(self.message, self.segment, self.data, 0, 0)
        return self._at(self.message, self.segment, self._pointer(index))

    def floats(self, index: int) -> tuple[float, ...]:
        """Return a list of 32-bit numbers, empty if it is null."""
        found = self._list(index)
        if found is None:
            return ()
        start, count, bits = found
        if bits != 32:
            raise MessageError(f"expected a list of 32-bit numbers, found {bits} bits")
        return struct.unpack_from(f"<{count}f", self.message.body, start)

    def structs(self, index: int) -> list[Struct]:
        """Return a list of structs, empty if it is null."""
        if index >= self.pointers:
            return []
        value, segment, base = self.message.pointer(self.segment, self._pointer(index))
        if value == 0:
            return []
        if value & 3 != _LIST or (value >> 32) & 7 != _COMPOSITE:
            raise MessageError("expected a list of structs")
        words, start = value >> 35, _target(value, base)
        self.message.checked(segment, start, WORD * (words + 1))
        (tag,) = struct.unpack_from("<Q", self.message.body, start)
        count = (tag & 0xFFFFFFFF) >> 2
        data_bytes, pointers = WORD * ((tag >> 32) & 0xFFFF), tag >> 48
        stride = data_bytes + WORD * pointers
        if count * stride > WORD * words or (not stride and count):
            raise MessageError("a list of structs longer than itself")
        first = start + WORD
        return [
            Struct(self.message, segment, first + i * stride, data_bytes, pointers)
            for i in range(count)
        ]

    def blob(self, index: int) -> bytes:
        """Return a list of bytes, empty if it is null."""
        found = self._list(index)
        if found is None:
            return b""
        start, count, bits = found
        if bits != 8:
            raise MessageError(f"expected bytes, found {bits} bits")
        return self.message.body[start : start + count]

    def _pointer(self, index: int) -> int:
        return self.data + self.data_bytes + WORD * index

    def _list(self, index: int) -> tuple[int, int, int] | None:
        """Return offset, count and bits per element of a list of numbers; None if it is null."""
        if index >= self.pointers:
            return None
        value, segment, base = self.message.pointer(self.segment, self._pointer(index))
        if value == 0:
            return None
        kind, count = (value >> 32) & 7, value >> 35
        if value & 3 != _LIST or kind >= len(_BITS_OF_ELEMENT):
            raise MessageError("expected a list of numbers")
        bits = _BITS_OF_ELEMENT[kind]
        start = self.message.checked(segment, _target(value, base), (count * bits + 7) // 8)
        return start, count, bits
