"""Masks of a network with a model card are used in eq. 13, 15 and 16."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from crosscue.eval import cli
from crosscue.eval.runs.folder import open_run
from support.onnx_models import constant_model, write_card
from support.pictures import picture_folder

# Size of the network's input; pictures of 24 x 16 pixels are stretched to it.
WIDTH, HEIGHT = 64, 32
# Box of one car: four times as long as high in the input, and three times in the picture.
BOX = np.array([8.0, 12.0, 56.0, 24.0])
VEHICLE = """version = 1
[cars]
kind = "pairs"
[regions]
kind = "picture"
left = [[0.0, 0.0], [0.25, 0.0], [0.25, 1.0], [0.0, 1.0]]
straight = [[0.25, 0.0], [0.75, 0.0], [0.75, 1.0], [0.25, 1.0]]
right = [[0.75, 0.0], [1.0, 0.0], [1.0, 1.0], [0.75, 1.0]]
"""


def prototypes(nose: str) -> NDArray[np.float32]:
    """32 masks at a quarter of the input's size; the first is a car with its nose at ``nose``."""
    masks = np.full((1, 32, HEIGHT // 4, WIDTH // 4), -9.0, np.float32)
    masks[0, 0, 3:6, 2:14] = 9.0
    masks[0, 0, 3:5, 9:14] = -9.0
    if nose == "left":
        masks[0, 0, :, 2:14] = masks[0, 0, :, 13:1:-1].copy()
    return masks


def seg(nose: str) -> tuple[str, dict[str, NDArray[np.generic]]]:
    """Outputs of an Ultralytics ``-seg`` network."""
    columns = np.zeros((1, 4 + 1 + 32, 50), np.float32)
    x0, y0, x1, y1 = BOX
    columns[0, :6, 30] = [(x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0, 0.99, 1.0]
    output = 'kind = "yolov8-seg"\nname = "output0"\nprototypes = "output1"\n'
    return output, {"output0": columns, "output1": prototypes(nose)}


def end_to_end(nose: str) -> tuple[str, dict[str, NDArray[np.generic]]]:
    """Outputs of a network with built-in suppression."""
    rows = np.zeros((1, 5, 6 + 32), np.float32)
    rows[0, 0, :7] = [*BOX, 0.99, 0.0, 1.0]
    output = 'kind = "end-to-end"\nname = "output0"\nprototypes = "output1"\n'
    return output, {"output0": rows, "output1": prototypes(nose)}


def torchvision(nose: str) -> tuple[str, dict[str, NDArray[np.generic]]]:
    """Outputs of a Mask R-CNN of torchvision, whose masks cover the whole input."""
    mask = (prototypes(nose)[0, :1] > 0).repeat(4, axis=1).repeat(4, axis=2).astype(np.float32)
    return 'kind = "torchvision"\nmasks = "masks"\n', {
        "boxes": BOX[None].astype(np.float32),
        "labels": np.ones(1, np.int64),
        "scores": np.full(1, 0.99, np.float32),
        "masks": mask[None],
    }


LAYOUTS = {"yolov8-seg": seg, "end-to-end": end_to_end, "torchvision": torchvision}


def replay_constant_network(
    folder: Path, output: str, classes: list[str], outputs: Mapping[str, NDArray[np.generic]]
) -> Path:
    """Replay three pictures with a network that returns the same outputs for each."""
    model = constant_model((1, 3, HEIGHT, WIDTH), outputs)
    output += f"classes = {json.dumps(classes)}"
    write_card(folder, model, output, (WIDTH, HEIGHT), 'fit = "stretch"')
    (folder / "car.toml").write_text(VEHICLE)
    log, out = picture_folder(folder / "front", 3, "rate_hz: 10\n"), folder / "out"
    argv = ["replay", log, "--detectors", folder / "net.toml", "--vehicle", folder / "car.toml"]
    assert cli.run([*map(str, argv), "--no-cache", "-q", "-o", str(out)]) == 0
    return out


def positive(out: Path) -> dict[str, int]:
    """Return the number of positive frames of each cue."""
    counts: dict[str, int] = {}
    for row in open_run(out).table("cues").to_pylist():
        counts[row["cue"]] = counts.get(row["cue"], 0) + (row["count"] > 0)
    return counts


@pytest.mark.parametrize("nose", ["left", "right"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_mask_shows_orientation_of_parked_car(tmp_path: Path, layout: str, nose: str) -> None:
    output, outputs = LAYOUTS[layout](nose)

    out = replay_constant_network(tmp_path, output, ["car"], outputs)

    found = positive(out)
    other = "right" if nose == "left" else "left"
    assert (found[f"parked_{nose}"], found[f"parked_{other}"]) == (2, 0)
    detected = open_run(out).drive_manifest().detected
    assert detected is not None
    (detector,) = detected.detectors
    assert (detector.with_mask, detector.boxes_only) == (("car",), ())


def test_road_segmentation_card_yields_road_cue_on_its_side_only(tmp_path: Path) -> None:
    """The network reports road in the left quarter of the picture."""
    scores = np.zeros((1, 2, HEIGHT // 4, WIDTH // 4), np.float32)
    scores[0, 1, :, : WIDTH // 16] = 1.0
    scores[0, 0] = 0.5

    output = 'kind = "segmentation"\nroad = ["road"]\n'
    out = replay_constant_network(tmp_path, output, ["other", "road"], {"map": scores})

    (row, *_) = open_run(out).table("road").to_pylist()
    assert [row[f"fraction_{side}"] for side in ("left", "straight", "right")] == [1.0, 0.0, 0.0]
    found = positive(out)
    assert [found[f"road_{side}"] for side in ("left", "straight", "right")] == [3, 0, 0]
