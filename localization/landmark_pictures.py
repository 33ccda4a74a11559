"""Encoded pictures as grey pixels, for feature matching; sizes are checked before decoding.

OpenCV is given bytes, never a file's name (it crashes on names that are not UTF-8), and only after
the picture's own header has said how large it will be: a megabyte of PNG can ask for gigabytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.replay.columns import Bytes, Images
from crosscue.replay.errors import LogError, LogFormatError, LogTooLargeError
from crosscue.replay.limits import DEFAULT, Limits
from crosscue.replay.picture_sizes import size_in_header
from crosscue.replay.readers.picture_bytes import damage_of

MOST_PIXELS: Final = 64_000_000
"""Largest picture decoded: 64 MB of grey."""


@dataclass(frozen=True, slots=True)
class EncodedPicture:
    """One picture of an ``Images`` block, copied out of the block's buffer.

    Attributes:
        coding: As in ``Images``.
        content: Its bytes.
        width_px: Of a raw picture.
        height_px: Of a raw picture.
        step_bytes: Of a raw picture.
        pixel_format: Of a raw picture.
    """

    coding: str
    content: bytes
    width_px: int = 0
    height_px: int = 0
    step_bytes: int = 0
    pixel_format: str = ""


def picture_of(images: Images, row: int) -> EncodedPicture:
    """One row of a block."""
    content = bytes(images.bytes_.payload(row))
    if images.coding[row] != "raw":
        return EncodedPicture(images.coding[row], content)
    width_px, height_px, step_bytes = (
        0 if column is None else int(column[row])
        for column in (images.width_px, images.height_px, images.step_bytes)
    )
    pixel_format = "" if images.pixel_format is None else images.pixel_format[row]
    return EncodedPicture("raw", content, width_px, height_px, step_bytes, pixel_format)


def read_picture(path: Path, limits: Limits = DEFAULT) -> EncodedPicture:
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
    return EncodedPicture(coding, content)


def grey_of(picture: EncodedPicture) -> Bytes:
    """The picture's pixels, shape (H, W), uint8.

    Raises:
        LogFormatError: Damaged, cut short, or of a coding that is not decoded here.
        LogTooLargeError: It says it has more than ``MOST_PIXELS``.
    """
    if picture.coding == "raw":
        return _raw_grey(picture)
    size = size_in_header(picture.content, picture.coding)
    if size is None:
        raise LogFormatError(f"{picture.coding} picture: no size in it, or a coding not decoded")
    _check_size(*size)
    why = damage_of(picture.content, picture.coding)
    if why is not None:
        raise LogFormatError(f"{picture.coding} {why}")
    import cv2

    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        grey = cv2.imdecode(np.frombuffer(picture.content, np.uint8), flags)
    except cv2.error as error:
        raise LogFormatError(f"{picture.coding} picture does not decode: {error.err}") from None
    if grey is None or grey.shape != (size[1], size[0]):
        raise LogFormatError(f"{picture.coding} picture does not decode")
    return np.asarray(grey, np.uint8)


def _check_size(width_px: int, height_px: int) -> None:
    if width_px < 1 or height_px < 1:
        raise LogFormatError(f"picture of {width_px} x {height_px} pixels: want at least one")
    if width_px * height_px > MOST_PIXELS:
        raise LogTooLargeError(
            f"picture of {width_px} x {height_px} pixels: more than {MOST_PIXELS:,} are not decoded"
        )


_RAW_WEIGHTS: Final = {
    "mono8": (1.0,), "8UC1": (1.0,),
    "rgb8": (0.299, 0.587, 0.114), "bgr8": (0.114, 0.587, 0.299), "8UC3": (0.114, 0.587, 0.299),
    "rgba8": (0.299, 0.587, 0.114, 0.0), "bgra8": (0.114, 0.587, 0.299, 0.0),
}  # fmt: skip


def _raw_grey(picture: EncodedPicture) -> Bytes:
    weights = _RAW_WEIGHTS.get(picture.pixel_format)
    if weights is None:
        raise LogFormatError(f"raw picture in {picture.pixel_format!r} is not decoded here")
    _check_size(picture.width_px, picture.height_px)
    row = picture.width_px * len(weights)
    step = picture.step_bytes or row
    if step < row or len(picture.content) < step * (picture.height_px - 1) + row:
        raise LogFormatError("raw picture has fewer bytes than its size needs")
    flat = np.frombuffer(picture.content, np.uint8)
    rows = np.lib.stride_tricks.as_strided(
        flat, (picture.height_px, row), (step, 1), writeable=False
    )
    if len(weights) == 1:
        return rows.copy()
    colours = rows.reshape(picture.height_px, picture.width_px, len(weights))
    grey: Bytes = np.round(colours @ np.array(weights)).astype(np.uint8)
    return grey


def _coding_of(content: bytes) -> str | None:
    if content.startswith(b"\x89PNG\r\n\x1a\n"):
        return "png"
    if content.startswith(b"\xff\xd8\xff"):
        return "jpeg"
    if content.startswith(b"RIFF") and content[8:12] == b"WEBP":
        return "webp"
    return None
