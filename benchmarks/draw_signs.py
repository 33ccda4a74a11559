"""Draw the sign pictures stored in the repository; they were drawn with OpenCV 5.0.0.

Another version of OpenCV has other fonts and draws other pictures: run this only to change a sign.

    python benchmarks/draw_signs.py FOLDER

writes ``FOLDER/detectors`` and ``FOLDER/scenes``, for comparison with ``detectors/signs/drawings``
and ``datasets/scenes/rendering/drawings``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.signs.templates import FILES_PX, KINDS, Kind, sign_size, template_file
from crosscue.replay.columns import Bytes

Rgba = NDArray[np.uint8]
Rgb = tuple[int, int, int]

RED: Final[Rgb] = (178, 28, 38)
WHITE: Final[Rgb] = (238, 238, 234)
BLACK: Final[Rgb] = (22, 22, 22)
# Factor of the drawing's size; averaging it down makes smooth edges.
OVER: Final = 4
# Width of the signs of simulated scenes.
SCENE_PX: Final = 128

_BLACK, _RED, _WHITE, _AROUND = 25, 85, 235, 140
_OVERSIZE: Final = 8


def main() -> None:
    """Write all pictures to the given folder."""
    into = Path(sys.argv[1])
    for name in ("detectors", "scenes"):
        (into / name).mkdir(parents=True, exist_ok=True)
    for kind in KINDS:
        for height in FILES_PX:
            cv2.imwrite(
                str(into / "detectors" / template_file(kind, height)), grey_sign(kind, height)
            )
    for name, draw in SIGNS.items():
        rgba = draw(SCENE_PX)
        cv2.imwrite(str(into / "scenes" / f"{name}.png"), rgba[..., [2, 1, 0, 3]])


def grey_sign(kind: Kind, height_px: int) -> Bytes:
    """Return a sign for the detector, reduced from a larger drawing to soften its edges."""
    size = sign_size(kind, height_px)
    width, height = size[0] * _OVERSIZE, size[1] * _OVERSIZE
    if kind.startswith("one way"):
        large = _grey_one_way(width, height, is_left=kind == "one way left")
    else:
        large = _disc(width, has_text=kind == "do not enter")
    return np.asarray(cv2.resize(large, size, interpolation=cv2.INTER_AREA), np.uint8)


def stop(size_px: int = 256) -> Rgba:
    """Return a red octagon with white border and the word STOP."""
    n = size_px * OVER
    canvas = _blank(n, n)
    _fill(canvas, _octagon(n, 0.5), WHITE)
    _fill(canvas, _octagon(n, 0.475), RED)
    _word(canvas, "STOP", (0.5, 0.5), 0.34, 0.80, WHITE, 0.05)
    return _shrunk(canvas)


def do_not_enter(size_px: int = 256) -> Rgba:
    """Return a red disc with a white bar on a white square, between DO NOT and ENTER."""
    n = size_px * OVER
    canvas = _blank(n, n)
    _fill(canvas, _box(n, 0.0, 0.0, 1.0, 1.0), WHITE)
    cv2.circle(canvas, (n // 2, n // 2), round(0.46 * n), (*RED, 255), -1)
    _fill(canvas, _box(n, 0.16, 0.435, 0.84, 0.565), WHITE)
    _word(canvas, "DO NOT", (0.5, 0.30), 0.12, 0.52, WHITE, 0.022)
    _word(canvas, "ENTER", (0.5, 0.70), 0.12, 0.46, WHITE, 0.022)
    return _shrunk(canvas)


def one_way_left(size_px: int = 256) -> Rgba:
    """Return a black board with a white arrow to the left that contains ONE WAY."""
    return _one_way(size_px, points_left=True)


def one_way_right(size_px: int = 256) -> Rgba:
    """Return a black board with a white arrow to the right that contains ONE WAY."""
    return _one_way(size_px, points_left=False)


def speed_limit(size_px: int = 256) -> Rgba:
    """Return a white board with the text SPEED LIMIT 30."""
    n = size_px * OVER
    canvas = _blank(n, n * 5 // 4)
    high = canvas.shape[0] / n
    _fill(canvas, _box(n, 0.0, 0.0, 1.0, high), WHITE)
    _word(canvas, "SPEED", (0.5, 0.18), 0.16, 0.74, BLACK, 0.035)
    _word(canvas, "LIMIT", (0.5, 0.42), 0.16, 0.66, BLACK, 0.035)
    _word(canvas, "30", (0.5, 0.85), 0.46, 0.66, BLACK, 0.08)
    return _shrunk(canvas)


SIGNS: Final[Mapping[str, Callable[[int], Rgba]]] = {
    "stop_sign": stop,
    "do_not_enter": do_not_enter,
    "one_way_left": one_way_left,
    "one_way_right": one_way_right,
    "speed_limit": speed_limit,
}


def _one_way(size_px: int, *, points_left: bool) -> Rgba:
    n = size_px * OVER
    canvas = _blank(n, n // 3)
    high = canvas.shape[0] / n
    _fill(canvas, _box(n, 0.0, 0.0, 1.0, high), BLACK)
    middle = high / 2
    arrow = np.array(
        [
            [0.035, middle],
            [0.215, 0.045],
            [0.215, 0.10],
            [0.965, 0.10],
            [0.965, high - 0.10],
            [0.215, high - 0.10],
            [0.215, high - 0.045],
        ]
    )
    text_at = 0.57
    if not points_left:
        arrow[:, 0], text_at = 1.0 - arrow[:, 0], 1.0 - text_at
    _fill(canvas, arrow * n, WHITE)
    _word(canvas, "ONE WAY", (text_at, middle), 0.095, 0.66, BLACK, 0.02)
    return _shrunk(canvas)


def _blank(wide: int, high: int) -> Rgba:
    return np.zeros((high, wide, 4), np.uint8)


def _octagon(n: int, radius: float) -> NDArray[np.float64]:
    # A flat top: corners at odd multiples of 22.5 degrees; radius is half the height.
    angle = np.deg2rad(22.5 + 45.0 * np.arange(8))
    corners: NDArray[np.float64] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return n * (0.5 + radius / float(np.cos(np.deg2rad(22.5))) * corners)


def _box(n: int, x0: float, y0: float, x1: float, y1: float) -> NDArray[np.float64]:
    return n * np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _fill(canvas: Rgba, points: NDArray[np.float64], rgb: Rgb) -> None:
    cv2.fillPoly(canvas, [np.rint(points).astype(np.int32)], (*rgb, 255))


def _word(
    canvas: Rgba,
    text: str,
    middle: tuple[float, float],
    high: float,
    wide: float,
    rgb: Rgb,
    stroke: float,
) -> None:
    """Draw single-stroke letters stretched to a box; sizes are in widths of the canvas."""
    n = canvas.shape[1]
    letters: NDArray[np.uint8] = np.zeros((400, 200 * len(text) + 200), np.uint8)
    cv2.putText(letters, text, (60, 290), cv2.FONT_HERSHEY_SIMPLEX, 8.0, 255, 1)
    rows, columns = np.flatnonzero(letters.any(1)), np.flatnonzero(letters.any(0))
    x = np.array([columns[0], columns[-1]], np.float64)
    y = np.array([rows[0], rows[-1]], np.float64)
    size_x, size_y = (wide - stroke) * n, (high - stroke) * n
    left, top = middle[0] * n - size_x / 2, middle[1] * n - size_y / 2
    points = np.argwhere(letters > 0)
    px = np.rint(left + (points[:, 1] - x[0]) / (x[1] - x[0]) * size_x).astype(int)
    py = np.rint(top + (points[:, 0] - y[0]) / (y[1] - y[0]) * size_y).astype(int)
    ink: NDArray[np.uint8] = np.zeros(canvas.shape[:2], np.uint8)
    ink[py.clip(0, ink.shape[0] - 1), px.clip(0, ink.shape[1] - 1)] = 255
    across = max(3, round(stroke * n)) | 1
    round_nib = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (across, across))
    canvas[cv2.dilate(ink, round_nib) > 0] = (*rgb, 255)


def _shrunk(canvas: Rgba) -> Rgba:
    high, wide = canvas.shape[0] // OVER, canvas.shape[1] // OVER
    blocks = canvas[: high * OVER, : wide * OVER].reshape(high, OVER, wide, OVER, 4)
    alpha = blocks[..., 3:].astype(np.float64)
    total = alpha.sum((1, 3))
    colour = (blocks[..., :3] * alpha).sum((1, 3)) / np.maximum(total, 1.0)
    return np.concatenate([colour, total / OVER**2], axis=2).round().astype(np.uint8)


def _grey_one_way(width: int, height: int, is_left: bool) -> Bytes:
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
    side = sign.shape[1]
    (unit, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 1)
    scale = width * side / unit
    place = (round(at[0] * side), round(at[1] * sign.shape[0]))
    thick = max(round(side * 0.012), 1)
    cv2.putText(sign, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (shade,), thick, cv2.LINE_AA)


if __name__ == "__main__":
    main()
