"""Determine the coding of a picture from its first bytes, or from its label if they are unclear."""

from typing import Final

from crosscue.replay.columns import ImageCoding

# Number of first bytes that ``coding_of`` examines.
MAGIC_BYTES: Final = 12
MAX_SIDE_PX: Final = 65_535

# Suffixes of files that are read as images.
IMAGE_SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".webp")
JPEG: Final = b"\xff\xd8"
_LABELS: Final[tuple[tuple[str, ImageCoding], ...]] = (
    ("jpeg", "jpeg"),
    ("jpg", "jpeg"),
    ("png", "png"),
    ("webp", "webp"),
    ("tiff", "tiff"),
    ("bmp", "bmp"),
)
# Codings by supported label of ``CompressedVideo``.
STREAMS: Final[dict[str, ImageCoding]] = {
    "h264": "h264",
    "h265": "h265",
    "hevc": "h265",
    "av1": "av1",
}


def coding_of(first: bytes, label: str) -> ImageCoding | None:
    """Return the coding of a picture, or None if neither its bytes nor its label identify it.

    Args:
        first: The picture's first ``MAGIC_BYTES`` bytes, or fewer.
        label: The message's ``format``, for example ``jpeg`` or ``rgb8; jpeg compressed bgr8``.
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
