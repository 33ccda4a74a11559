"""Pictures for feature matching: grey, at full size, of files as well as of logs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

from crosscue.detectors.base import View
from crosscue.detectors.images import Encoded, decode, encoded, read_file
from crosscue.replay.base import DEFAULT_LIMITS, Bytes, Images, Limits, LogError

GREY: Final = View(is_grey=True)


def picture_of(images: Images, row: int) -> Encoded:
    """One row of a block, copied out of the block's buffer, which is large and would stay."""
    picture = encoded(images, row)
    return replace(picture, content=memoryview(bytes(picture.content)))


def read_picture(path: Path, limits: Limits = DEFAULT_LIMITS) -> Encoded:
    """A picture file, not decoded yet.

    Raises:
        LogError: It cannot be read.
        LogTooLargeError: Larger than one encoded picture may be.
        LogFormatError: No picture that is known here.
    """
    try:
        return read_file(path, limits.message_bytes)
    except OSError as error:
        raise LogError(f"{path}: {error.strerror}; give a picture") from None
    except LogError as error:
        raise type(error)(f"{path}: {error}; give another") from None


def grey_of(picture: Encoded) -> Bytes:
    """The picture's pixels, shape (H, W), uint8.

    Raises:
        LogFormatError: Damaged, cut short, or of a coding that is not decoded here.
        LogTooLargeError: It says it has more pixels than are decoded.
    """
    return decode(picture, GREY)[0]
