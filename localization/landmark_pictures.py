"""Pictures for feature matching: grey, at full size, of files as well as of logs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

from crosscue.detectors.base import View
from crosscue.detectors.pictures import Encoded, decode, encoded
from crosscue.replay.columns import Bytes, Images
from crosscue.replay.errors import LogError, LogFormatError, LogTooLargeError
from crosscue.replay.limits import DEFAULT, Limits

GREY: Final = View(is_grey=True)


def picture_of(images: Images, row: int) -> Encoded:
    """One row of a block, copied out of the block's buffer, which is large and would stay."""
    picture = encoded(images, row)
    return replace(picture, content=memoryview(bytes(picture.content)))


def read_picture(path: Path, limits: Limits = DEFAULT) -> Encoded:
    """A picture file, not decoded yet.

    Raises:
        LogError: It cannot be read.
        LogTooLargeError: Larger than one encoded picture may be.
        LogFormatError: No picture that is known here.
    """
    try:
        if not path.is_file():
            raise LogError(f"{path}: no such file; give a picture")
        if path.stat().st_size > limits.message_bytes:
            raise LogTooLargeError(
                f"{path}: {path.stat().st_size:,} bytes, more than {limits.message_bytes:,} for "
                "one picture; make it smaller"
            )
        content = path.read_bytes()
    except OSError as error:
        raise LogError(f"{path}: {error.strerror}; check the path and its mode") from None
    coding = _coding_of(content)
    if coding is None:
        raise LogFormatError(f"{path}: no picture that is known here; give PNG, JPEG or WebP")
    return Encoded(coding, memoryview(content))


def grey_of(picture: Encoded) -> Bytes:
    """The picture's pixels, shape (H, W), uint8.

    Raises:
        LogFormatError: Damaged, cut short, or of a coding that is not decoded here.
        LogTooLargeError: It says it has more pixels than are decoded.
    """
    return decode(picture, GREY)[0]


def _coding_of(content: bytes) -> str | None:
    if content.startswith(b"\x89PNG\r\n\x1a\n"):
        return "png"
    if content.startswith(b"\xff\xd8\xff"):
        return "jpeg"
    if content.startswith(b"RIFF") and content[8:12] == b"WEBP":
        return "webp"
    return None
