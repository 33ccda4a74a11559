"""Drawn scenes with signs, and pictures of lights."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

import crosscue
from crosscue.detectors.signs.templates import MARGIN_PX, Kind, draw_sign_template
from crosscue.replay.columns import Bytes, Floats

from .onnx_models import bright_box_model, write_card
from .pictures import picture_log


class Scene(NamedTuple):
    """A picture and the box of the one sign in it."""

    grey: Bytes
    box: Floats


def clutter(seed: int, size_px: tuple[int, int] = (640, 360)) -> Bytes:
    """Draw rectangles, lines and noise as a cluttered background."""
    rng = np.random.default_rng(seed)
    width, height = size_px
    grey = np.full((height, width), 150, np.uint8)
    for _ in range(60):
        x, y = int(rng.integers(0, width)), int(rng.integers(0, height))
        w, h = int(rng.integers(5, 90)), int(rng.integers(5, 60))
        shade = (int(rng.integers(20, 240)),)
        cv2.rectangle(grey, (x, y), (x + w, y + h), shade, -1)
        cv2.line(grey, (x, y), (x + 3 * w, y - h), shade, int(rng.integers(1, 4)))
    noisy = grey + rng.normal(0.0, 4.0, grey.shape)
    return np.asarray(np.clip(noisy, 0, 255), np.uint8)


def scene(kind: Kind, seed: int, height_px: int | None = None) -> Scene:
    """One sign at a random position in clutter, 44 to 110 pixels high (one-way signs half that)."""
    rng = np.random.default_rng(seed)
    height = int(rng.integers(44, 110)) if height_px is None else height_px
    drawing = draw_sign_template(kind, height)
    inner = drawing.grey[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX].astype(np.float64)
    inner = inner * rng.uniform(0.6, 1.0) + rng.uniform(0.0, 20.0)
    grey = clutter(seed + 1000)
    h, w = inner.shape
    x, y = int(rng.integers(10, 620 - w)), int(rng.integers(10, 250 - h))
    grey[y : y + h, x : x + w] = np.clip(inner + rng.normal(0.0, 4.0, inner.shape), 0, 255)
    grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), 0.7), np.uint8)
    return Scene(grey, np.array([x, y, x + w, y + h], np.float64))


SIZE = (64, 48)
OUTPUT = 'kind = "end-to-end"\nclasses = ["traffic light", "bench"]\nscore = 0.3'


def boxes(values: Iterable[float]) -> Iterable[NDArray[np.uint8]]:
    """Yield black pictures with a box of each grey value."""
    for value in values:
        pixels = np.zeros(SIZE[::-1], np.uint8)
        pixels[8:24, 16:32] = round(value)
        yield pixels


def write_lights(folder: Path, pictures: int) -> Path:
    """Write a log, its labels, the card of a network that finds the box, and what it found."""
    rng = np.random.default_rng(4)
    scores, labels = rng.uniform(0.5, 1.0, pictures), folder / "labels"
    picture_log(folder / "log", boxes(255 * scores))
    labels.mkdir()
    (labels / "classes.txt").write_text("Traffic-Light\nvan\n")
    is_light = rng.random(pictures) < 1.0 / (1.0 + np.exp(-25.0 * (scores - 0.65)))
    row = f"0 {24 / 64} {16 / 48} {16 / 64} {16 / 48}\n"
    for number, there in enumerate(is_light):
        (labels / f"frame_{number}.txt").write_text(row if there else "")
    card = write_card(folder, bright_box_model(score="share"), OUTPUT)
    crosscue.detect_drive(folder / "log", folder / "run", detectors=[str(card)])
    return folder
