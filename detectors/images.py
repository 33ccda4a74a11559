"""Decode pictures safely: sizes are checked first, and no file name reaches OpenCV.

A megabyte of PNG can decode to gigabytes, so the picture's header is read first. EXIF orientation
is ignored: calibration refers to the pixels in the sensor's order.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.replay.columns import Bytes, Images
from crosscue.replay.decode.coding import MAGIC_BYTES, coding_of
from crosscue.replay.errors import LogError, LogFormatError, LogTooLargeError
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.files.image_header import size_in_header
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import DEFAULT_LIMITS
from crosscue.replay.readers.images.damage import damage_of

from .base import View

# Size of the largest picture that is decoded: 192 MB in colour.
MAX_PIXELS: Final = 64_000_000
# Reason of a dropped row: damaged, too large, or empty; the detail says which.
NOT_DECODED: Final = "picture not decoded"
# Factors by which a JPEG decoder can reduce a picture while decoding.
_REDUCTIONS: Final = (8, 4, 2)


@dataclass(frozen=True, slots=True)
class Encoded:
    """One picture of an ``Images`` block.

    Attributes:
        coding: As in ``Images``.
        content: The encoded bytes, not copied.
        layout: Width, height, bytes per row and pixel format of a raw picture, else None.
    """

    coding: str
    content: memoryview
    layout: tuple[int, int, int, str] | None = None


def encoded(images: Images, row: int) -> Encoded:
    """Return the picture in one row of a block."""
    content, coding = images.bytes_.payload(row), images.coding[row]
    columns = (images.width_px, images.height_px, images.step_bytes)
    if coding != "raw" or images.pixel_format is None:
        return Encoded(coding, content)
    width, height, step = (0 if column is None else int(column[row]) for column in columns)
    return Encoded(coding, content, (width, height, step, images.pixel_format[row]))


def read_file(path: Path, max_bytes: int = DEFAULT_LIMITS.message_bytes) -> Encoded:
    """Read a picture file; its format is recognised from the content, not from the name.

    Raises:
        OSError: The file cannot be read.
        LogFormatError: It is not a JPEG, PNG or WebP picture.
        LogTooLargeError: It has more than ``max_bytes``.
    """
    content = read_at_most(path, max_bytes)
    if content is None:
        raise LogTooLargeError(
            f"picture of {path.stat().st_size} bytes: more than {max_bytes} are not read"
        )
    coding = coding_of(content[:MAGIC_BYTES], "")
    if coding is None:
        raise LogFormatError("not a JPEG, PNG or WebP picture" if content else "empty picture")
    return Encoded(coding, memoryview(content))


def picture_size(picture: Encoded) -> tuple[int, int]:
    """Read width and height from the picture's header.

    Raises:
        LogFormatError: The header has no size, or the coding is not supported.
        LogTooLargeError: The picture has more than ``MAX_PIXELS``.
    """
    if picture.layout is not None:
        size: tuple[int, int] | None = picture.layout[:2]
    else:
        size = size_in_header(picture.content, picture.coding)
    if size is None:
        raise LogFormatError(f"{picture.coding} picture without a size, or not decoded here")
    if min(size) < 1:
        raise LogFormatError(f"picture of {size[0]} x {size[1]} pixels: expected at least one")
    if size[0] * size[1] > MAX_PIXELS:
        raise LogTooLargeError(
            f"picture of {size[0]} x {size[1]} pixels: more than {MAX_PIXELS:,} are not decoded"
        )
    return size


def check(picture: Encoded) -> tuple[int, int]:
    """Return width and height of a picture, and check without decoding that it is complete.

    Raises:
        LogFormatError: The picture is empty, damaged, truncated or of an unsupported coding.
        LogTooLargeError: As ``picture_size``.
    """
    if not len(picture.content):
        raise LogFormatError("empty picture")
    size = picture_size(picture)
    if picture.layout is None and (why := damage_of(bytes(picture.content), picture.coding)):
        raise LogFormatError(f"{picture.coding} {why}")
    return size


def lose(ledger: Ledger, topic: str, t_ns: int, error: LogError) -> None:
    """Drop a picture of a log that cannot be used; its command processes the others."""
    ledger.spoil(topic, NOT_DECODED, 1, f"at {t_ns} ns: {error}", t_ns)


WHOLE: Final = View()


def decode(
    picture: Encoded, view: View = WHOLE, depth_bits: int = 16
) -> tuple[Bytes, tuple[int, int]]:
    """Decode a picture; return its pixels, and width and height at full size.

    Args:
        picture: Encoded picture.
        view: Minimum width and channels; a JPEG is decoded at the smallest sufficient scale.
        depth_bits: Number of bits that the camera uses in a 16-bit picture (often 12).

    Raises:
        LogFormatError: The picture is damaged, truncated or of an unsupported coding.
        LogTooLargeError: As ``picture_size``.
    """
    size = check(picture)
    if picture.layout is not None:
        return _raw(picture, picture.layout, view, depth_bits), size
    by = reduction(size[0], view) if picture.coding == "jpeg" else 1
    return _compressed(picture, size, by, view, depth_bits), size


def reduction(width_px: int, view: View) -> int:
    """Largest factor of 8, 4, 2, 1 that keeps at least the view's width."""
    if view.min_width_px is None:
        return 1
    return next((by for by in _REDUCTIONS if width_px // by >= view.min_width_px), 1)


def _compressed(
    picture: Encoded, size: tuple[int, int], by: int, view: View, depth_bits: int
) -> Bytes:
    import cv2

    # OpenCV's numbers of the modes: grey reductions 16, 32, 64; colour 17, 33, 65.
    mode = (0 if view.is_grey else 1) if by == 1 else 8 * by + (not view.is_grey)
    flags = int(mode) | cv2.IMREAD_IGNORE_ORIENTATION | (0 if by > 1 else cv2.IMREAD_ANYDEPTH)
    try:
        pixels = cv2.imdecode(np.frombuffer(picture.content, np.uint8), flags)
    except cv2.error as error:
        raise LogFormatError(f"{picture.coding} picture does not decode: {error.err}") from None
    want = (-(-size[1] // by), -(-size[0] // by))
    if pixels is None or pixels.shape[:2] != want:
        raise LogFormatError(f"{picture.coding} picture does not decode")
    return _eight_bits(np.asarray(pixels), depth_bits)


def _eight_bits(pixels: np.ndarray[tuple[int, ...], np.dtype[np.generic]], bits: int) -> Bytes:
    if pixels.dtype == np.uint8:
        return np.asarray(pixels, np.uint8)
    if pixels.dtype != np.uint16:
        raise LogFormatError(f"picture with {pixels.dtype} pixels is not decoded here")
    shifted = np.asarray(pixels, np.uint16) >> max(bits - 8, 0)
    return np.asarray(np.minimum(shifted, 255), np.uint8)


# Channels, bytes per channel and OpenCV's conversion to BGR, by ROS encoding.
_RAW: Final = {
    "mono8": (1, 1, None), "8UC1": (1, 1, None), "mono16": (1, 2, None), "16UC1": (1, 2, None),
    "bgr8": (3, 1, None), "8UC3": (3, 1, None), "rgb8": (3, 1, "COLOR_RGB2BGR"),
    "bgra8": (4, 1, "COLOR_BGRA2BGR"), "rgba8": (4, 1, "COLOR_RGBA2BGR"),
    "bayer_rggb8": (1, 1, "COLOR_BayerRGGB2BGR"), "bayer_bggr8": (1, 1, "COLOR_BayerBGGR2BGR"),
    "bayer_gbrg8": (1, 1, "COLOR_BayerGBRG2BGR"), "bayer_grbg8": (1, 1, "COLOR_BayerGRBG2BGR"),
}  # fmt: skip


def _raw(picture: Encoded, layout: tuple[int, int, int, str], view: View, bits: int) -> Bytes:
    width, height, step, name = layout
    if name not in _RAW:
        raise LogFormatError(f"raw picture in {name!r} is not decoded; there are: {sorted(_RAW)}")
    channels, depth, conversion = _RAW[name]
    row = width * channels * depth
    step = step or row
    if step < row or len(picture.content) < step * (height - 1) + row:
        raise LogFormatError("raw picture has fewer bytes than its size needs")
    flat = np.frombuffer(picture.content, np.uint8)
    rows = np.lib.stride_tricks.as_strided(flat, (height, row), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(rows)
    if depth == 2:
        pixels = _eight_bits(pixels.view("<u2"), bits)
    pixels = pixels.reshape((height, width) if channels == 1 else (height, width, channels))
    import cv2

    if conversion is not None:
        pixels = np.asarray(cv2.cvtColor(pixels, getattr(cv2, conversion)), np.uint8)
    return channels_as(pixels, view.is_grey)


def channels_as(pixels: Bytes, is_grey: bool) -> Bytes:
    """Convert pixels to one channel or to three."""
    import cv2

    if is_grey == (pixels.ndim == 2):
        return pixels
    turn = cv2.COLOR_BGR2GRAY if is_grey else cv2.COLOR_GRAY2BGR
    return np.asarray(cv2.cvtColor(pixels, turn), np.uint8)
