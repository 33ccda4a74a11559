"""Encode masks as COCO's compressed run-length text, a few hundred bytes for a car.

Pixels are counted down the columns from the top left. Runs of background and object alternate,
starting with background. The text encodes the runs' lengths in groups of five bits, from the
fourth run on as the difference to the run two before. This is the coding of COCO annotations, so
other tools read it.

pycocotools writes the same bytes but is not used here, for two reasons (benchmarks/mask_runs.py).
For a mask known in a box it needs the whole picture, which takes 15 to 30 times as long on
1280 x 720, to encode or to decode. For damaged text it returns more pixels than the picture has,
where this module raises an error.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

_BASE: Final = 48
_MORE: Final = 0x20
_SIGN: Final = 0x10
# Maximum number of five-bit groups in a run's length: 35 bits.
_LONGEST: Final = 7


def encode_mask(
    mask: NDArray[np.bool_], corner_px: tuple[int, int], size_px: tuple[int, int]
) -> bytes:
    """Encode the mask of an object that is known only inside a box.

    Args:
        mask: Shape (h, w): object pixels inside the box.
        corner_px: Column and row of the box's top-left pixel.
        size_px: Width and height of the whole picture.

    Raises:
        ValueError: The box is not inside the picture.
    """
    (column, row), (width, height) = corner_px, size_px
    h, w = mask.shape
    if column < 0 or row < 0 or column + w > width or row + h > height:
        raise ValueError(f"mask {w} x {h} at {column}, {row}: not inside {width} x {height}")
    padded = np.zeros((w, h + 2), np.int8)
    padded[:, 1:-1] = mask.T
    turns = np.diff(padded, axis=1)
    origin = (column + np.arange(w)[:, None]) * height + row + np.arange(h + 1)[None, :]
    starts, stops = origin[turns == 1], origin[turns == -1]
    if len(starts) > 1:
        is_apart = np.append(stops[:-1] != starts[1:], True)
        starts, stops = starts[np.append(True, is_apart[:-1])], stops[is_apart]
    edges = np.empty(2 * len(starts), np.int64)
    edges[0::2], edges[1::2] = starts, stops
    lengths = np.diff(np.concatenate([[0], edges, [width * height]]))
    return _to_text(lengths[:-1] if len(edges) and lengths[-1] == 0 else lengths)


def runs(text: bytes) -> NDArray[np.int64]:
    """Decode the lengths of the alternating runs of background and object.

    Raises:
        ValueError: The text is not a compressed mask.
    """
    # There are many short texts, so speed depends on the number of calls.
    codes = np.frombuffer(text, np.uint8) - np.uint8(_BASE)
    if len(codes) == 0 or codes.max() > 63 or codes[-1] & _MORE:
        raise ValueError(f"not a compressed mask: {text[:20]!r}")
    is_last = codes < _MORE
    last = np.flatnonzero(is_last)
    values: NDArray[np.int64] = ((codes[last] ^ _SIGN).astype(np.int64)) - _SIGN
    if len(last) < len(codes):
        values = _joined(codes, last, text)
    values[1::2] = values[1::2].cumsum()
    values[2::2] = values[2::2].cumsum()
    if values.min() < 0:
        raise ValueError(f"not a compressed mask, a run is negative: {text[:20]!r}")
    return values


def _joined(codes: NDArray[np.uint8], last: NDArray[np.intp], text: bytes) -> NDArray[np.int64]:
    """Join the five-bit groups of each value, whose last groups are at the places ``last``."""
    first = np.zeros_like(last)
    first[1:] = last[:-1] + 1
    counts = last - first + 1
    if counts.max() > _LONGEST:
        raise ValueError(f"not a compressed mask, a run is too long: {text[:20]!r}")
    groups = (codes & 0x1F).astype(np.int64)
    # The last group has a sign.
    groups[last] = (groups[last] ^ _SIGN) - _SIGN
    groups <<= 5 * (np.arange(len(codes)) - first.repeat(counts))
    return np.asarray(np.add.reduceat(groups, first), np.int64)


def area_px(text: bytes) -> int:
    """Number of the object's pixels."""
    return int(runs(text)[1::2].sum())


def column_heights_px(text: bytes, size_px: tuple[int, int]) -> NDArray[np.float64]:
    """Number of object pixels in each column of the picture, shape (width,).

    Raises:
        ValueError: The text is not a compressed mask, or not of this size.
    """
    width, height = size_px
    lengths = runs(text)
    edges = lengths.cumsum()
    _check_pixels(int(edges[-1]), size_px)
    objects, stops = lengths[1::2], edges[1::2]
    column = (stops - objects) // height
    if (column == (stops - 1) // height).all():
        return np.asarray(np.bincount(column, objects, width), np.float64)
    # A run continues into the next column. Between two edges the count of object pixels is
    # linear, so interpolating it at the columns' borders is exact.
    counted = np.zeros(len(edges) + 1)
    objects.cumsum(out=counted[2::2])
    counted[3::2] = counted[2:-1:2]
    borders = np.arange(width + 1) * height
    return np.diff(np.interp(borders, np.concatenate([[0], edges]), counted))


def decode_mask(text: bytes, size_px: tuple[int, int]) -> NDArray[np.bool_]:
    """Decode the mask of the whole picture, shape (height, width).

    Raises:
        ValueError: As ``column_heights_px``.
    """
    width, height = size_px
    lengths = checked_runs(text, size_px)
    is_object = np.arange(len(lengths)) % 2 == 1
    return np.repeat(is_object, lengths).reshape(width, height).T


def checked_runs(text: bytes, size_px: tuple[int, int]) -> NDArray[np.int64]:
    """Decode the runs of the whole picture.

    Raises:
        ValueError: As ``column_heights_px``.
    """
    lengths = runs(text)
    _check_pixels(int(lengths.sum()), size_px)
    return lengths


def _check_pixels(reported: int, size_px: tuple[int, int]) -> None:
    if reported != size_px[0] * size_px[1]:
        raise ValueError(f"mask of {reported} pixels: expected {size_px[0]} x {size_px[1]}")


def _to_text(lengths: NDArray[np.int64]) -> bytes:
    values = lengths.copy()
    values[3:] -= lengths[1:-2]
    groups = (values[:, None] >> (5 * np.arange(_LONGEST))) & 0x1F
    rests = values[:, None] >> (5 * np.arange(1, _LONGEST + 1))
    is_done = rests == np.where(groups & _SIGN, -1, 0)
    count = is_done.argmax(axis=1) + 1
    place = np.arange(_LONGEST)[None, :]
    codes = np.where(place < count[:, None] - 1, groups | _MORE, groups) + _BASE
    return bytes(codes[place < count[:, None]].astype(np.uint8))


def outline(
    mask: bytes, size_px: tuple[int, int], box_px: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Closed outlines of a mask, shape (N, 2) each, to the pixel; empty for an empty mask."""
    if not mask:
        return []
    x0, y0 = (int(v) for v in np.maximum(np.floor(box_px[:2]) - 1, 0))
    x1, y1 = (int(v) for v in np.ceil(box_px[2:]) + 1)
    return borders(decode_mask(mask, size_px)[y0:y1, x0:x1], (x0, y0))


def borders(mask: NDArray[np.bool_], corner_px: tuple[int, int]) -> list[NDArray[np.float64]]:
    """Closed outlines of the parts of a mask whose top-left pixel is ``corner_px``."""
    import cv2

    inside = np.ascontiguousarray(mask).view(np.uint8)
    found, _ = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    rounded = [cv2.approxPolyDP(line, 1.0, closed=True)[:, 0, :] for line in found]
    corner = np.array(corner_px, np.float64) + 0.5
    return [corner + np.vstack([line, line[:1]]) for line in rounded if len(line) > 2]
