"""Read width and height of an encoded picture from its header, without decoding it.

A megabyte of PNG can decode to gigabytes, so the size is checked before decoding.
"""

import struct
from typing import Final

_JPEG_SIZES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_BARE: Final = frozenset({0x01, *range(0xD0, 0xD8)})


def size_in_header(content: bytes | memoryview, coding: str) -> tuple[int, int] | None:
    """Return width and height from the header of a JPEG, PNG, WebP or BMP picture, or None.

    Args:
        content: The complete picture.
        coding: Coding of the picture; the header of another coding yields None.
    """
    head = bytes(content[:32])
    if coding == "png" and head.startswith(b"\x89PNG\r\n\x1a\n") and len(head) >= 24:
        width, height = struct.unpack_from(">II", head, 16)
        return width, height
    if coding == "jpeg" and head.startswith(b"\xff\xd8\xff"):
        return _jpeg_size(content)
    if coding == "webp" and head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return _webp_size(head) if len(head) >= 30 else None
    if coding == "bmp" and head.startswith(b"BM") and len(head) >= 26:
        width, height = struct.unpack_from("<ii", head, 18)
        return width, abs(height)
    return None


def _jpeg_size(content: bytes | memoryview) -> tuple[int, int] | None:
    """Read the segments up to the frame header (ITU T.81, B.1 and B.2.2)."""
    at = 2
    while at + 9 <= len(content) and content[at] == 0xFF:
        marker = content[at + 1]
        if marker == 0xFF:
            at += 1
        elif marker in _JPEG_BARE:
            at += 2
        elif marker in _JPEG_SIZES:
            height, width = struct.unpack_from(">HH", content, at + 5)
            return width, height
        else:
            at += 2 + max(int.from_bytes(content[at + 2 : at + 4], "big"), 2)
    return None


def _webp_size(head: bytes) -> tuple[int, int] | None:
    """Read the size from the first chunk (RFC 9649, sections 2.5 to 2.7)."""
    kind = head[12:16]
    if kind == b"VP8X":
        width = int.from_bytes(head[24:27], "little") + 1
        return width, int.from_bytes(head[27:30], "little") + 1
    if kind == b"VP8L":
        bits = int.from_bytes(head[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", head, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None
