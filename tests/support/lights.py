"""Pictures of one box, which is a traffic light the more often the brighter it is."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import crosscue

from .onnx_models import bright_box_model, write_card
from .pictures import picture_log

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
