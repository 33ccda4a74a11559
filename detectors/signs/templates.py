"""Our own drawings of the signs that rule a turn out, in grey, as an ORB matcher wants them.

One-way arrows (US R6-1), do not enter (US R5-1) and the international no-entry disc (Vienna C1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from crosscue.replay.columns import Bytes

Kind = Literal["one way left", "one way right", "do not enter", "no entry"]
KINDS: Final[tuple[Kind, ...]] = ("one way left", "one way right", "do not enter", "no entry")
AMERICAN: Final[tuple[Kind, ...]] = KINDS[:3]
LABELS: Final = {"no entry": "do not enter"}
"""The international disc says what the American sign says."""
MARGIN_PX: Final = 12
"""Grey around a drawing, so that points at its edge have a neighbourhood."""
_BLACK, _RED, _WHITE, _AROUND = 25, 85, 235, 140
_OVERSIZE: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """One sign at one size.

    Attributes:
        kind: Which.
        grey: Shape (h, w), uint8, with ``MARGIN_PX`` around the sign.
        size_px: Width and height of the sign itself.
    """

    kind: Kind
    grey: Bytes
    size_px: tuple[int, int]


def drawings(kinds: Sequence[Kind] = KINDS, heights_px: Sequence[int] = (48, 64)) -> list[Drawing]:
    """Each kind at each height; one-way signs at half the height and thrice as wide."""
    return [draw(kind, height) for kind in kinds for height in heights_px]


def draw(kind: Kind, height_px: int) -> Drawing:
    """One sign; drawn large, then shrunk, so that edges are as soft as a camera's.

    Raises:
        ValueError: Too small to show anything.
    """
    if height_px < 16:
        raise ValueError(f"height_px: want at least 16, got {height_px}")
    is_arrow = kind.startswith("one way")
    size = (height_px * 3 // 2, height_px // 2) if is_arrow else (height_px, height_px)
    width, height = size[0] * _OVERSIZE, size[1] * _OVERSIZE
    if is_arrow:
        large = _one_way(width, height, is_left=kind == "one way left")
    else:
        large = _disc(width, has_text=kind == "do not enter")
    import cv2

    small = cv2.resize(large, size, interpolation=cv2.INTER_AREA)
    grey = np.full((size[1] + 2 * MARGIN_PX, size[0] + 2 * MARGIN_PX), _AROUND, np.uint8)
    grey[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX] = small
    return Drawing(kind, np.asarray(cv2.GaussianBlur(grey, (3, 3), 0.6), np.uint8), size)


def _one_way(width: int, height: int, is_left: bool) -> Bytes:
    import cv2

    sign = np.full((height, width), _BLACK, np.uint8)
    shape = np.array(
        [
            (0.04, 0.5),
            (0.24, 0.08),
            (0.24, 0.28),
            (0.96, 0.28),
            (0.96, 0.72),
            (0.24, 0.72),
            (0.24, 0.92),
        ]
    )
    if not is_left:
        shape[:, 0] = 1.0 - shape[:, 0]
    cv2.fillPoly(sign, [np.round(shape * (width, height)).astype(np.int32)], _WHITE)
    begin = 0.3 if is_left else 0.1
    _write(sign, "ONE WAY", (begin, 0.62), 0.6, _BLACK)
    return sign


def _disc(side: int, has_text: bool) -> Bytes:
    import cv2

    sign = np.full((side, side), _WHITE if has_text else _AROUND, np.uint8)
    middle = (side // 2, side // 2)
    cv2.circle(sign, middle, round(side * 0.48), _RED, -1, cv2.LINE_AA)
    high = 0.07 if has_text else 0.1
    low, top = (round(side * 0.14), round(side * (0.5 - high))), round(side * (0.5 + high))
    cv2.rectangle(sign, low, (round(side * 0.86), top), _WHITE, -1)
    if has_text:
        _write(sign, "DO NOT", (0.26, 0.36), 0.48, _WHITE)
        _write(sign, "ENTER", (0.29, 0.76), 0.42, _WHITE)
    return sign


def _write(sign: Bytes, text: str, at: tuple[float, float], width: float, shade: int) -> None:
    import cv2

    side = sign.shape[1]
    (unit, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 1)
    scale = width * side / unit
    place = (round(at[0] * side), round(at[1] * sign.shape[0]))
    thick = max(round(side * 0.012), 1)
    cv2.putText(sign, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (shade,), thick, cv2.LINE_AA)
