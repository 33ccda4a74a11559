"""Damage checks of encoded images, by checksums, lengths and end markers, without decoding."""

import struct
import zlib
from typing import Final

_PNG_HEAD: Final = 8
_JPEG_END: Final = b"\xff\xd9"
# Number of bytes searched for the end marker, because cameras append padding and metadata.
_JPEG_TAIL: Final = 4096

CUT: Final = "picture cut short"
DAMAGED: Final = "picture damaged (checksum)"

# Checks of ``damage_of`` by coding, for the summary of a log.
CHECKED: Final = {
    "png": "PNG: every chunk's CRC verified",
    "jpeg": "JPEG: no checksum, end marker seen",
    "webp": "WebP: no checksum, length compared",
}


def damage_of(picture: bytes, coding: str) -> str | None:
    """Return the reason why an image is damaged, or None if no damage is detected.

    Args:
        picture: Bytes of the image.
        coding: ``jpeg``, ``png`` or ``webp``; others are not checked.
    """
    if coding == "png":
        return _png_damage(picture)
    if coding == "jpeg":
        # Coded pixels never contain the marker, because 0xFF is always followed by 0 there.
        return None if _JPEG_END in picture[-_JPEG_TAIL:] else CUT
    if coding == "webp":
        declared = struct.unpack_from("<I", picture, 4)[0] + 8
        return None if len(picture) >= declared else CUT
    return None


def _png_damage(picture: bytes) -> str | None:
    """Check every chunk: length, type, content, CRC of type and content."""
    at = _PNG_HEAD
    while at + 12 <= len(picture):
        (length,) = struct.unpack_from(">I", picture, at)
        stop = at + 12 + length
        if stop > len(picture):
            return CUT
        content = memoryview(picture)[at + 4 : stop - 4]
        if zlib.crc32(content) != struct.unpack_from(">I", picture, stop - 4)[0]:
            return DAMAGED
        if bytes(content[:4]) == b"IEND":
            return None
        at = stop
    return CUT
