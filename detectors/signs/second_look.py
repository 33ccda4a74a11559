"""Look again at a box that a network calls a stop sign or a traffic light.

A network for everyday objects calls other signs stop signs, too: the back of one, a no-entry disc,
an orange work-zone sign, a yellow warning sign. Three properties tell them apart. The face of a
stop sign is red. Its letters are white; those of a work-zone sign, whose orange is red in some
light, are black. And they are a pale band over a third of its height, where a no-entry disc has a
white bar over a sixth. The map of redness is compared with both by normalised correlation, which
does not depend on brightness or contrast, on a grid so coarse that letters blur to a band. At
night, headlamps wash a face out: its red turns pale and its letters run together to a bar.

A "signal ahead" sign shows a light on a yellow diamond, so what is beside a light must not be
yellow. On eleven drives it is beside 35 boxes of such a sign, and beside none of 2,809 others.

On 78 boxes above a score of 0.05 of street photographs, LISA frames and photographs of no-entry
signs, examined by eye, 33 of 38 stop signs look like one and none like another sign. Of 40 other
boxes, one looks like a stop sign (a reflection of one in water) and 24 like other signs.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.ranging.lens import lens_of

# Version of the rule; cached results of other versions are not used.
VERSION: Final = 3
Look = Literal["stop", "bar", "orange", "yellow", "pale", "plain", "unknown"]
# Looks of other signs, with their description.
OTHER_SIGNS: Final = {
    "bar": "a white bar",
    "orange": "orange",
    "yellow": "yellow",
    "pale": "not red",
    "plain": "no white letters",
}
# Width or height below which the letters and a bar cannot be told apart.
MIN_SIDE_PX: Final = 12.0
# Side of the grid of the comparison.
GRID: Final = 16
# Minimum saturation and value, of 255, of a coloured pixel.
MIN_SATURATION: Final = 70
MIN_VALUE: Final = 40
# Upper ends of red, orange and yellow in OpenCV's half degrees; red goes on above ``RED_FROM``.
HUES: Final = (8, 22, 38)
RED_FROM: Final = 160
# Fraction of the face that must have one colour.
MIN_COLOUR: Final = 0.4
# Median value below which a picture is too dark for colours.
MIN_LIGHT: Final = 40.0
# Median value of a picture below which it is night, and the ratio to it of a face's brightest
# quarter above which headlamps wash the face out.
NIGHT: Final = 60.0
GLARE: Final = 3.0
# Beside a light: nearest and furthest columns and half the height of the rows, in longer sides of
# the box, the least saturation of a sign's yellow, and the least share of it on either side.
BESIDE: Final = (0.28, 0.5, 0.2)
YELLOW_SATURATION: Final = 120
MIN_YELLOW: Final = 0.4
# Half the height and width of the band of letters, in half sides of the sign, and the least share
# of white in its light: the weakest colour is none in red, orange and black. It is 0.33 to 0.77 on
# 36 stop signs by day, 0.48 to 0.78 at night, and 0.02 to 0.06 on an orange sign that looks red.
LETTERS: Final = (0.34, 0.78)
MIN_WHITE: Final = 0.2
# Minimum correlation with a stop sign, and minimum differences between the two correlations.
MIN_ALIKE: Final = 0.6
IS_STOP: Final = 0.03
IS_BAR: Final = 0.06
# Scales and vertical shifts of the box that are tried, because boxes are not exact.
SCALES: Final = (0.9, 1.0, 1.1)
SHIFTS: Final = (-0.06, 0.0, 0.06)


def look_at_sign(pixels: NDArray[np.uint8], box_px: NDArray[np.float64]) -> Look:
    """Look at one box; ``unknown`` if it is too small, too dark, or of a grey picture.

    Args:
        pixels: Shape (H, W, 3), blue, green, red; or (H, W) grey.
        box_px: x0, y0, x1, y1 in those pixels.
    """
    if pixels.ndim == 2 or float(np.min(box_px[2:] - box_px[:2])) < MIN_SIDE_PX:
        return "unknown"
    import cv2

    face = cv2.resize(_cut(pixels, box_px), (2 * GRID, 2 * GRID), interpolation=cv2.INTER_AREA)
    y, x = _grid(2 * GRID)
    # Inside a circle, without the corners beyond the octagon.
    hue, saturation, value = np.asarray(cv2.cvtColor(face, cv2.COLOR_BGR2HSV))[x**2 + y**2 < 0.8].T
    if np.median(value) < MIN_LIGHT:
        return "unknown"
    is_coloured = (saturation >= MIN_SATURATION) & (value >= MIN_VALUE)
    red, orange, yellow = (
        float((is_coloured & of_hue).mean())
        for of_hue in (
            (hue <= HUES[0]) | (hue >= RED_FROM),
            (hue > HUES[0]) & (hue <= HUES[1]),
            (hue > HUES[1]) & (hue <= HUES[2]),
        )
    )
    if red < MIN_COLOUR:
        if max(orange, yellow) >= MIN_COLOUR:
            return "orange" if orange > yellow else "yellow"
        is_pale = red + orange + yellow < 0.5 * MIN_COLOUR
        return "pale" if is_pale and not _is_glare(pixels, value) else "unknown"
    letters = face[(np.abs(y) < LETTERS[0]) & (np.abs(x) < LETTERS[1])]
    if letters.min(axis=1).sum() < MIN_WHITE * letters.max(axis=1).sum():
        return "plain"
    stop, bar = _alike(pixels, box_px)
    if bar > stop + IS_BAR:
        return "unknown" if _is_glare(pixels, value) else "bar"
    return "stop" if stop >= max(bar + IS_STOP, MIN_ALIKE) else "unknown"


def look_at_light(pixels: NDArray[np.uint8], box_px: NDArray[np.float64]) -> Look | Literal[""]:
    """Return ``yellow`` if a box, or what is in it, is drawn on a yellow sign; else nothing.

    Args:
        pixels: Shape (H, W, 3), blue, green, red; or (H, W) grey.
        box_px: x0, y0, x1, y1 in those pixels.
    """
    side_px = float(np.max(box_px[2:] - box_px[:2]))
    if pixels.ndim == 2 or side_px < MIN_SIDE_PX:
        return ""
    import cv2

    (x, y), (near, far, half) = 0.5 * (box_px[:2] + box_px[2:]), side_px * np.array(BESIDE)
    for left, right in ((x - far, x - near), (x + near, x + far)):
        beside = _cut(pixels, np.array([left, y - half, right, y + half]))
        hue, saturation, value = cv2.split(cv2.cvtColor(beside, cv2.COLOR_BGR2HSV))
        is_yellow = (hue > HUES[0]) & (hue <= HUES[2]) & (saturation >= YELLOW_SATURATION)
        if (is_yellow & (value >= 2 * MIN_VALUE)).mean() < MIN_YELLOW:
            return ""
    return "yellow"


def with_looks(
    found: Detections, frame: Frame, signs: tuple[str, ...], lights: tuple[str, ...] = ()
) -> Detections:
    """Add the second look at stop signs and traffic lights, and the lenses of the lights.

    Args:
        found: Detections in one frame.
        frame: The decoded frame, which may be smaller than the camera's picture.
        signs: Labels of stop signs.
        lights: Labels of traffic lights.
    """
    if not {*signs, *lights} & {*found.labels}:
        return found
    boxes_px = found.boxes_px / np.array([*frame.scale, *frame.scale])
    looks, lenses = [""] * len(found), [""] * len(found)
    for i, label in enumerate(found.labels):
        if label in signs:
            looks[i] = look_at_sign(frame.pixels, boxes_px[i])
        elif label in lights:
            looks[i] = look_at_light(frame.pixels, boxes_px[i])
            lenses[i] = lens_of(frame.pixels, boxes_px[i])
    return replace(found, looks=tuple(looks), lenses=tuple(lenses))


def _is_glare(pixels: NDArray[np.uint8], value: NDArray[np.uint8]) -> bool:
    """Whether headlamps at night wash out a face with these values."""
    night = float(np.median(pixels[::8, ::8].max(axis=2)))
    return night < NIGHT and float(np.percentile(value, 75)) > GLARE * night


def _alike(pixels: NDArray[np.uint8], box_px: NDArray[np.float64]) -> tuple[float, float]:
    """Correlation of a box's redness with a stop sign's and a no-entry disc's, at the best fit."""
    import cv2

    center, side = 0.5 * (box_px[:2] + box_px[2:]), box_px[2:] - box_px[:2]
    best = [-1.0, -1.0]
    for scale in SCALES:
        for shift in SHIFTS:
            middle = center + np.array([0.0, shift * side[1]])
            cut = _cut(
                pixels, np.concatenate([middle - 0.5 * scale * side, middle + 0.5 * scale * side])
            )
            blue, green, red = np.moveaxis(cut.astype(np.float64), 2, 0)
            redness = np.clip((red - np.maximum(green, blue)) / np.maximum(red, 30.0), 0.0, 1.0)
            small = cv2.resize(redness, (GRID, GRID), interpolation=cv2.INTER_AREA)
            best = [
                max(one, _correlation(small, face)) for one, face in zip(best, _FACES, strict=True)
            ]
    return best[0], best[1]


def _cut(pixels: NDArray[np.uint8], box_px: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Cut a box out of a picture; its edge continues beyond it."""
    x0, y0, x1, y1 = np.round(box_px).astype(int).tolist()
    height, width = pixels.shape[:2]
    x1, y1 = max(x1, x0 + 1), max(y1, y0 + 1)
    if min(x0, y0) >= 0 and x1 <= width and y1 <= height:
        return pixels[y0:y1, x0:x1]
    rows = np.clip(np.arange(y0, y1), 0, height - 1)
    columns = np.clip(np.arange(x0, x1), 0, width - 1)
    return np.asarray(pixels[np.ix_(rows, columns)])


def _grid(side: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rows and columns of a square grid, each from -1 to 1."""
    y, x = (np.mgrid[:side, :side] + 0.5) * 2.0 / side - 1.0
    return y, x


def _correlation(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    one, other = one - one.mean(), other - other.mean()
    return float((one * other).sum() / np.sqrt((one**2).sum() * (other**2).sum() + 1e-9))


def _faces() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Redness of a stop sign, whose letters are blurred, and of a no-entry disc."""
    fine = 10
    y, x = _grid(GRID * fine)
    is_octagon = (np.maximum(abs(x), abs(y)) < 0.94) & (abs(x) + abs(y) < 0.94 * np.sqrt(2.0))
    has_letters = (abs(y) < LETTERS[0]) & (abs(x) < LETTERS[1])
    is_disc = x**2 + y**2 < 0.92
    is_bar = (abs(y) < 0.17) & (abs(x) < 0.78)
    stop = is_octagon * np.where(has_letters, 0.5, 1.0)
    disc = (is_disc & ~is_bar).astype(np.float64)
    parts = (GRID, fine, GRID, fine)
    return stop.reshape(parts).mean(axis=(1, 3)), disc.reshape(parts).mean(axis=(1, 3))


_FACES: Final = _faces()
