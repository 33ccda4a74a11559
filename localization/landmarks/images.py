"""Read grey pictures of full size, from files and logs, for feature matching."""

from dataclasses import replace
from pathlib import Path
from typing import Final

from crosscue.detectors.base import View
from crosscue.detectors.images import Encoded, decode, encoded, read_file
from crosscue.replay.columns import Bytes, Images
from crosscue.replay.errors import LogError
from crosscue.replay.limits import DEFAULT_LIMITS, Limits

GREY: Final = View(is_grey=True)


def copy_picture(images: Images, row: int) -> Encoded:
    """Copy one picture of a block, so that the block's large buffer can be released."""
    picture = encoded(images, row)
    return replace(picture, content=memoryview(bytes(picture.content)))


def read_encoded(path: Path, limits: Limits = DEFAULT_LIMITS) -> Encoded:
    """Read a picture file without decoding it.

    Raises:
        LogError: The file cannot be read.
        LogTooLargeError: The file exceeds the maximum size of an encoded picture.
        LogFormatError: The file is not a supported picture.
    """
    try:
        return read_file(path, limits.message_bytes)
    except OSError as error:
        raise LogError(f"{path}: {error.strerror}; expected a picture") from None
    except LogError as error:
        raise type(error)(f"{path}: {error}; use another picture") from None


def grey_of(picture: Encoded) -> Bytes:
    """Decode a picture to grey pixels, shape (H, W), uint8.

    Raises:
        LogFormatError: The picture is damaged, truncated or of an unsupported coding.
        LogTooLargeError: The picture exceeds the maximum number of pixels.
    """
    return decode(picture, GREY)[0]
