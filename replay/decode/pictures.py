"""Combine single pictures from protobuf or JSON messages into columns."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from crosscue.replay.columns import Block, Bytes, ImageCoding, Images, Messages
from crosscue.replay.ledger import Ledger

from .coding import MAX_SIDE_PX, STREAMS, coding_of
from .foxglove import PictureKind
from .refuse import EMPTY_PICTURE, IMAGE_CODING, MISFIT, VIDEO_CODING, refuse

_NO_TIME: Final = 0


@dataclass(frozen=True, slots=True)
class PictureRow:
    """One picture message.

    Attributes:
        stamp_ns: The sensor's own time, or None.
        start: First byte in the buffer.
        stop: One past the last byte.
        magic: First bytes of the picture.
        label: ``format``, or ``encoding`` of a raw picture.
        width_px: Width of a raw picture.
        height_px: Height of a raw picture.
        step_bytes: Bytes per row of a raw picture.
    """

    stamp_ns: int | None
    start: int
    stop: int
    magic: bytes
    label: str
    width_px: int = 0
    height_px: int = 0
    step_bytes: int = 0


def images_of(
    block: Block, buffer: Bytes, picture: PictureKind, rows: list[PictureRow | str], ledger: Ledger
) -> Block:
    """Return a block of the pictures among ``rows``, and refuse the other rows.

    Args:
        block: The block as read, for its times.
        buffer: Buffer that ``start`` and ``stop`` refer to.
        picture: Kind of the pictures.
        rows: One element for each row of the block; a reason for a message that does not fit.
        ledger: Records skipped and dropped rows.
    """
    kept: list[int] = []
    good: list[PictureRow] = []
    codings: list[ImageCoding] = []
    for i, row in enumerate(rows):
        coding, reason, why = _judge(row, picture)
        if coding is None or isinstance(row, str):
            refuse(ledger, block, i, reason, why)
            continue
        kept.append(i)
        good.append(row)
        codings.append(coding)
    start = np.array([row.start for row in good], np.int64)
    stop = np.array([row.stop for row in good], np.int64)
    images = Images(Messages(buffer, start, stop), tuple(codings))
    if picture is PictureKind.RAW:
        images = replace(
            images,
            width_px=np.array([row.width_px for row in good], np.int32),
            height_px=np.array([row.height_px for row in good], np.int32),
            step_bytes=np.array([row.step_bytes for row in good], np.int32),
            pixel_format=tuple(row.label for row in good),
        )
    stamps = [row.stamp_ns for row in good]
    header_ns = None
    if all(stamp is not None for stamp in stamps):
        header_ns = np.array([stamp or _NO_TIME for stamp in stamps], np.int64)
    return replace(block.take(np.array(kept, np.intp)), rows=images, header_ns=header_ns)


def _judge(row: PictureRow | str, picture: PictureKind) -> tuple[ImageCoding | None, str, str]:
    """Return the picture's coding, or None with reason and detail."""
    if isinstance(row, str):
        return None, MISFIT, row
    if row.start == row.stop:
        return None, EMPTY_PICTURE, ""
    if picture is PictureKind.VIDEO:
        return STREAMS.get(row.label.lower()), VIDEO_CODING, row.label[:40]
    if picture is PictureKind.COMPRESSED:
        return coding_of(row.magic, row.label), IMAGE_CODING, row.label[:40]
    sides = (row.width_px, row.height_px)
    if min(sides) < 1 or max(sides) > MAX_SIDE_PX:
        return None, "implausible picture size", f"{row.width_px} x {row.height_px}"
    if row.step_bytes < row.width_px or row.stop - row.start < row.step_bytes * row.height_px:
        return None, "picture has fewer bytes than its size needs", ""
    return "raw", "", ""
