"""Which coding an encoded picture has: its first bytes say it, its label only where they do not."""

from __future__ import annotations

from typing import Final

from crosscue.replay.columns import ImageCoding

MAGIC_BYTES: Final = 12
"""As many first bytes as ``coding_of`` examines."""

IMAGE_SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".webp")
"""Of files that are read as images."""
JPEG: Final = b"\xff\xd8"
_LABELS: Final[tuple[tuple[str, ImageCoding], ...]] = (
    ("jpeg", "jpeg"),
    ("jpg", "jpeg"),
    ("png", "png"),
    ("webp", "webp"),
    ("tiff", "tiff"),
    ("bmp", "bmp"),
)
STREAMS: Final[dict[str, ImageCoding]] = {
    "h264": "h264",
    "h265": "h265",
    "hevc": "h265",
    "av1": "av1",
}
"""Labels of ``CompressedVideo`` that we know."""


def coding_of(first: bytes, label: str) -> ImageCoding | None:
    """The coding of a picture, or None where neither its bytes nor its label say one we know.

    Args:
        first: The picture's first ``MAGIC_BYTES`` bytes, or fewer.
        label: The message's ``format`` (``jpeg``, ``rgb8; jpeg compressed bgr8``).
    """
    if first.startswith(JPEG):
        return "jpeg"
    if first.startswith(b"\x89PNG\r\n\x1a\n"):
        return "png"
    if first.startswith(b"RIFF") and first[8:12] == b"WEBP":
        return "webp"
    if first.startswith((b"II*\x00", b"MM\x00*")):
        return "tiff"
    if first.startswith(b"BM"):
        return "bmp"
    low = label.lower()
    if low in STREAMS:
        return STREAMS[low]
    if "compresseddepth" in low:
        return None
    return next((coding for word, coding in _LABELS if word in low), None)
