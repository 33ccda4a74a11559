"""Our own drawings of the signs that rule a turn out, in grey, as an ORB matcher needs them.

They are read from files, as each version of OpenCV has letters of its own.

One-way arrows (US R6-1), do not enter (US R5-1) and the international no-entry disc (Vienna C1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

Kind = Literal["one way left", "one way right", "do not enter", "no entry"]
KINDS: Final[tuple[Kind, ...]] = ("one way left", "one way right", "do not enter", "no entry")
AMERICAN: Final[tuple[Kind, ...]] = KINDS[:3]
LABELS: Final = {"no entry": "do not enter"}
"""The international disc says what the American sign says."""
MARGIN_PX: Final = 12
"""Grey around a drawing, so that points at its edge have a neighbourhood."""
_AROUND: Final = 140
FILES_PX: Final = (48, 64, 512)
"""Heights of the stored drawings: the usual ones, and one to shrink to any other."""


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """One sign at one size.

    Attributes:
        kind: Which.
        grey: Shape (h, w), uint8, with ``MARGIN_PX`` around the sign.
        size_px: Width and height of the sign itself.
    """

    kind: Kind
    grey: NDArray[np.uint8]
    size_px: tuple[int, int]


def drawings(kinds: Sequence[Kind] = KINDS, heights_px: Sequence[int] = (48, 64)) -> list[Drawing]:
    """Each kind at each height; one-way signs at half the height and thrice as wide."""
    return [draw(kind, height) for kind in kinds for height in heights_px]


def draw(kind: Kind, height_px: int) -> Drawing:
    """One sign; at a height without a file, the largest one shrunk.

    Raises:
        ValueError: Too small to show anything, or larger than the largest file.
    """
    if not 16 <= height_px <= FILES_PX[-1]:
        raise ValueError(f"height_px: expected 16 to {FILES_PX[-1]}, got {height_px}")
    import cv2

    size = size_of(kind, height_px)
    sign = _stored(kind, height_px if height_px in FILES_PX else FILES_PX[-1])
    if sign.shape[::-1] != size:
        sign = np.asarray(cv2.resize(sign, size, interpolation=cv2.INTER_AREA), np.uint8)
    grey = np.full((size[1] + 2 * MARGIN_PX, size[0] + 2 * MARGIN_PX), _AROUND, np.uint8)
    grey[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX] = sign
    return Drawing(kind, np.asarray(cv2.GaussianBlur(grey, (3, 3), 0.6), np.uint8), size)


def size_of(kind: Kind, height_px: int) -> tuple[int, int]:
    """Width and height of a sign; a one-way sign is half as high and thrice as wide as that."""
    if kind.startswith("one way"):
        return height_px * 3 // 2, height_px // 2
    return height_px, height_px


def file_name(kind: Kind, height_px: int) -> str:
    """Of a stored drawing."""
    return f"{kind.replace(' ', '_')}_{height_px}.png"


def _stored(kind: Kind, height_px: int) -> NDArray[np.uint8]:
    import cv2

    path = files("crosscue.detectors.signs").joinpath("drawings", file_name(kind, height_px))
    data = np.frombuffer(path.read_bytes(), np.uint8)
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)
