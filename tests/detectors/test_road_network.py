"""Tests of the road network: training, resumption, checkpoints, and commands."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save

from crosscue.datasets.scenes.single_frames import load_folder
from crosscue.detectors.networks.road.checkpoint import RoadFacts, load_road, save_road
from crosscue.detectors.networks.road.detector import build
from crosscue.detectors.networks.road.network import RoadNetwork
from crosscue.detectors.training.road import RoadSchedule, RoadTraining, road_score
from crosscue.eval.cli import run
from crosscue.replay.columns import Bytes
from crosscue.replay.errors import VehicleError
from support.refusals import refusal

CPU = torch.device("cpu")


def scenes(n: int, seed: int = 0) -> tuple[Bytes, Bytes]:
    """Draw grey trapezoids on green, as the simplest road."""
    rng = np.random.default_rng(seed)
    pixels = np.zeros((n, 48, 80, 3), np.uint8)
    road = np.zeros((n, 48, 80), np.uint8)
    for i in range(n):
        pixels[i] = rng.normal((60, 120, 70), 12, (48, 80, 3)).clip(0, 255)
        middle, top = rng.integers(30, 50), rng.integers(18, 26)
        outline = np.array([[middle - 4, top], [middle + 4, top], [76, 47], [4, 47]])
        cv2.fillPoly(road[i], [outline], 255)
        pixels[i][road[i] > 0] = rng.normal(105, 12, ((road[i] > 0).sum(), 3)).clip(0, 255)
    return pixels, road


@pytest.mark.slow
def test_training_raises_the_iou_on_held_out_pictures() -> None:
    training = RoadTraining(RoadSchedule(steps=60, batch=6, warm_up=5), CPU)
    held = scenes(6, seed=1)
    before = road_score(training.network, *held, CPU)
    for _ in training.steps(*scenes(24)):
        pass

    after = road_score(training.network, *held, CPU)

    assert after.iou > max(0.8, before.iou)
    assert after.pictures == 6


@pytest.mark.slow
def test_resumed_training_matches_uninterrupted_training(tmp_path: Path) -> None:
    pixels, road = scenes(8)
    whole = RoadTraining(RoadSchedule(steps=6, batch=2), CPU)
    for _ in whole.steps(pixels, road):
        pass
    cut = RoadTraining(RoadSchedule(steps=6, batch=2), CPU)
    for done, _ in cut.steps(pixels, road):
        if done == 3:
            cut.save(tmp_path / "state")
            break
    again = RoadTraining(RoadSchedule(steps=6, batch=2), CPU)
    again.resume(tmp_path / "state")
    for _ in again.steps(pixels, road):
        pass

    for name, value in whole.network.state_dict().items():
        torch.testing.assert_close(again.network.state_dict()[name], value, rtol=1e-4, atol=1e-6)


def test_invalid_checkpoints_and_settings_are_refused(tmp_path: Path) -> None:
    save_road(tmp_path / "r.safetensors", RoadNetwork(), RoadFacts(width_px=80, height_px=48))
    whole = (tmp_path / "r.safetensors").read_bytes()
    for name, content, message in (
        ("cut.safetensors", whole[:-100], "not a safetensors file"),
        ("flipped.safetensors", whole[:-1] + bytes([whole[-1] ^ 1]), "damaged"),
        ("other.safetensors", save({"a": torch.zeros(1)}), "expected a file written by crosscue t"),
        ("r.pth", whole, "expected .safetensors"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(VehicleError, match=f"{name}: {message}"):
            load_road(tmp_path / name)
    with pytest.raises(VehicleError, match=r"none.safetensors: No such file"):
        build(checkpoint=str(tmp_path / "none.safetensors"))
    with pytest.raises(VehicleError, match=r"probability"):
        build(probability=1.0)


def folder(at: Path, n: int) -> Path:
    for name in ("images", "masks"):
        (at / name).mkdir(parents=True)
    pixels, road = scenes(n)
    for i in range(n):
        cv2.imwrite(str(at / "images" / f"{i:02d}.png"), pixels[i])
        cv2.imwrite(str(at / "masks" / f"{i:02d}.png"), road[i])
    return at


@pytest.mark.slow
def test_train_road_accepts_a_folder_of_pictures_and_masks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = folder(tmp_path / "own", 11)
    out = tmp_path / "own.safetensors"
    argv = (
        f"train road --data {data} -o {out} --steps 4 --stop-at 2 --batch 2 --width 128 "
        "--device cpu --json"
    ).split()

    assert run(argv) == 0

    assert '"held_out_pictures": 2' in capsys.readouterr().out
    recipe = load_road(out).facts.recipe
    assert (recipe["pictures"], recipe["steps"], recipe["stopped_at"]) == (9, 4, 2)
    assert not out.with_suffix(".state").exists()
    assert run(argv) == 1  # it already exists


def test_picture_with_missing_or_mismatched_mask_is_refused(tmp_path: Path) -> None:
    data = folder(tmp_path / "own", 2)
    cv2.imwrite(str(data / "masks" / "01.png"), np.zeros((4, 4), np.uint8))
    with pytest.raises(Exception, match=r"01.png: 80 x 48 pixels, but its mask has 4 x 4"):
        load_folder(data, (80, 48))

    (data / "masks" / "00.png").unlink()
    with pytest.raises(Exception, match=r"masks/00.png: No such file"):
        load_folder(data, (80, 48))


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--layouts", "A"], "only for scoring"),
        (["--layouts", "L1", "--val-layouts", "L1"], "also in --layouts"),
        (["--layouts", "Q"], "is not a layout"),
        (["--layouts", "L2-L1"], "expected the lower layout first"),
        (["--layouts", "L1", "--test-layouts", "Z"], "is not a layout"),
        (["--layouts", "L1", "L0-L3"], "L1: named twice"),
        (["--layouts", "L1", "--seed", "-1"], "expected 0 or more"),
        (["--layouts", "L1", "--threads", "-1"], "expected 0 or more"),
        (["--measure", "embedded", "--test-layouts", "A"], "cannot be combined with -o"),
        ([], "expected --layouts"),
    ],
)
def test_invalid_flags_are_reported(flags: list[str], message: str, tmp_path: Path) -> None:
    assert message in refusal(2, "train", "road", *flags, "-o", tmp_path / "o.safetensors")


@pytest.mark.slow
def test_train_road_measures_a_network_without_training(capsys: pytest.CaptureFixture[str]) -> None:
    measure = ["train", "road", "--measure", "embedded"]

    assert run([*measure, "--test-layouts", "L640", "--per-layout", "2", "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["measured_pictures"] == 2
    assert reported["measured_iou"] > 0.95
    assert "expected --test-layouts with layouts" in refusal(2, *measure)
