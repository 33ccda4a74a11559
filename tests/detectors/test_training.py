"""Training of the detector: data, resumption, measures, box-only data and equal bytes."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import crosscue
from crosscue.detectors import rle
from crosscue.detectors.base import Detections
from crosscue.detectors.networks.mask_rcnn.checkpoint import load_checkpoint
from crosscue.detectors.networks.mask_rcnn.network import build_network
from crosscue.detectors.training.annotations import LabelledSet, mask_of, read_training_coco
from crosscue.detectors.training.job import Training
from crosscue.detectors.training.loop import Schedule
from crosscue.detectors.training.measure import average_precisions, fitted
from crosscue.detectors.training.operating_point import Verdicts
from crosscue.detectors.training.samples import Sampler, SampleSettings
from crosscue.eval.cli import run
from crosscue.eval.training.mask_rcnn import MaskRcnnTrainingSettings
from crosscue.replay.errors import CrosscueError, SchemaError
from support.mask_rcnn import CPU, plan_of, write_bars
from support.pictures import picture
from support.refusals import refusal

WINDOW = SampleSettings(96, 64)
CARS = ("car",)


def _bars(folder: Path, count: int = 4) -> LabelledSet:
    return read_training_coco(write_bars(folder / "set", count), folder / "set" / "images", CARS)


def _changed(folder: Path, **rows: Any) -> LabelledSet:
    """Write a dataset of bars with changed top-level entries, and read it."""
    path = write_bars(folder / "set", 2)
    tree = json.loads(path.read_text())
    for name, value in rows.items():
        tree[name] = value(tree[name]) if callable(value) else value
    path.write_text(json.dumps(tree))
    return read_training_coco(path, folder / "set" / "images", CARS)


def _with(row: dict[str, Any]) -> Any:
    """Return a change that updates the first row with ``row``."""
    return lambda rows: [{**rows[0], **row}, *rows[1:]]


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        ({"bbox": [500, 10, 20, 20]}, "boxes outside the picture, or empty"),
        ({"bbox": [10, 10, 0, 20]}, "boxes outside the picture, or empty"),
        ({"bbox": [10, 10, -5, -5]}, "boxes outside the picture, or empty"),
        ({"bbox": [10, 10, 20]}, "annotations without a box"),
        ({"bbox": None}, "annotations without a box"),
        ({"bbox": [10, 10, "wide", 20]}, "annotations without a box"),
        ({"category_id": 77}, "annotations of unknown classes"),
        ({"category_id": [3]}, "annotations of unknown classes"),
        ({"category_id": 9}, "annotations of other classes"),
        ({"image_id": 99}, "annotations of other pictures"),
        ({"segmentation": [[1, 2, 3]]}, "annotations without a mask of the picture's size"),
        (
            {"segmentation": {"size": [9, 9], "counts": "0"}},
            "annotations without a mask of the picture's size",
        ),
        (
            {"segmentation": {"size": [96, 128], "counts": "~~~~~~~~~~~~"}},
            "annotations without a mask of the picture's size",
        ),
        (
            {"segmentation": {"size": [96, 128], "counts": [5, -5, 9]}},
            "annotations without a mask of the picture's size",
        ),
    ],
)
def test_unusable_annotation_is_dropped_and_counted(
    tmp_path: Path, row: dict[str, Any], reason: str
) -> None:
    labelled = _changed(tmp_path, annotations=_with(row))

    assert labelled.left_out == {reason: 1}
    assert sum(len(picture.objects) for picture in labelled.pictures) == 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"annotations": []}, "no usable annotation of car"),
        ({"images": []}, "none of its pictures"),
        ({"categories": []}, "no class of car; it has: none"),
        ({"annotations": {}}, "annotations: expected a list"),
        ({"images": [7]}, "images: expected a list"),
    ],
)
def test_dataset_without_usable_annotations_is_refused(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    with pytest.raises(SchemaError, match=message):
        _changed(tmp_path, **change)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("gone.png", "pictures not there"),
        ("../images/0.png", "pictures outside the folder"),
        ("/etc/passwd", "pictures outside the folder"),
        (7, "pictures without a name or size"),
    ],
)
def test_picture_not_in_the_folder_is_dropped_and_counted(
    tmp_path: Path, name: object, reason: str
) -> None:
    labelled = _changed(tmp_path, images=_with({"file_name": name}))

    assert len(labelled.pictures) == 1
    assert labelled.left_out == {reason: 1, "annotations of other pictures": 2}


def test_all_mask_encodings_decode_to_the_same_pixels(tmp_path: Path) -> None:
    mask = np.zeros((96, 128), np.bool_)
    mask[20:50, 30:90] = True
    text = rle.encode_mask(mask, (0, 0), (128, 96))
    encodings = (
        [[30, 20, 90, 20, 90, 50, 30, 50]],
        {"size": [96, 128], "counts": text.decode()},
        {"size": [96, 128], "counts": rle.runs(text).tolist()},
    )
    for number, encoding in enumerate(encodings):
        labelled = _changed(
            tmp_path / str(number),
            annotations=_with({"segmentation": encoding, "bbox": [30, 20, 60, 30]}),
        )
        got = mask_of(labelled.pictures[0].objects[0], (128, 96))
        assert not labelled.left_out
        assert (got ^ mask).sum() <= (0 if number else 2 * (30 + 60) + 4)


@pytest.mark.slow
@settings(max_examples=15)
@given(st.integers(0, 10_000))
def test_sample_boxes_enclose_their_masks_and_objects(
    tmp_path_factory: pytest.TempPathFactory, number: int
) -> None:
    labelled = _bars(tmp_path_factory.mktemp("bars"), 1)
    sampler = Sampler(labelled, plan_of(), WINDOW, 3)
    sample, again = sampler(number), sampler(number)

    assert np.array_equal(sample.pixels, again.pixels)
    assert sample.pixels.shape == (3, 64, 96)
    for box, mask in zip(sample.boxes_px, sample.masks, strict=True):
        rows, columns = np.nonzero(mask)
        assert box.tolist() == [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        inside, outside = sample.pixels[0][mask > 0], sample.pixels[0][sample.masks.max(0) == 0]
        assert inside.mean() > outside.mean()


def _training(folder: Path, schedule: Schedule) -> tuple[Training, Sampler]:
    plan = plan_of()
    training = Training(lambda: build_network(plan), schedule, CPU)
    return training, Sampler(_bars(folder), plan, WINDOW, schedule.seed)


@pytest.mark.slow
def test_resumed_training_equals_uninterrupted_training(tmp_path: Path) -> None:
    schedule = Schedule(4, batch=2, warm_up=1)
    whole, sampler = _training(tmp_path / "a", schedule)
    expected = [loss for _, loss in whole.steps(sampler)]
    cut, sampler = _training(tmp_path / "b", schedule)
    losses = []
    for step, loss in cut.steps(sampler):
        losses.append(loss)
        if step == 2:
            cut.save(tmp_path / "state.safetensors", {"word": 1})
            break
    later, sampler = _training(tmp_path / "c", schedule)

    assert later.resume(tmp_path / "state.safetensors") == {"word": 1}
    losses += [loss for _, loss in later.steps(sampler)]

    assert losses == expected
    for name, value in whole.averaged.state_dict().items():
        assert torch.equal(value, later.averaged.state_dict()[name])


def _perfect(labelled: LabelledSet) -> list[Detections]:
    found = []
    for number, shown in enumerate(labelled.pictures):
        boxes = np.array([one.box_px for one in shown.objects], np.float64).reshape(-1, 4)
        masks = tuple(
            rle.encode_mask(mask_of(one, shown.size_px), (0, 0), shown.size_px)
            for one in shown.objects
        )
        labels = tuple(labelled.classes[one.label] for one in shown.objects)
        scores = np.linspace(0.9, 0.5, len(labels))
        found.append(Detections(number, shown.size_px, boxes, scores, labels, masks))
    return found


def test_average_precision_is_100_for_ground_truth_and_0_for_no_detections(tmp_path: Path) -> None:
    labelled = _bars(tmp_path)
    perfect = _perfect(labelled)

    whole, none = (
        average_precisions(labelled, found)
        for found in (perfect, [one.taken(one.scores >= 2.0) for one in perfect])
    )

    assert whole["box"] == whole["mask"] == whole["box car"] == 100.0
    assert whole["box large"] is None
    assert none["box"] == none["mask"] == 0.0


def test_calibration_recovers_the_logistic_parameters() -> None:
    rng = np.random.default_rng(0)
    scores = rng.uniform(0.02, 0.98, 20_000)
    logit = np.log(scores / (1.0 - scores))
    is_right = rng.random(20_000) < 1.0 / (1.0 + np.exp(-(0.7 * logit - 1.0)))

    by = fitted(Verdicts(scores, is_right, 1))

    assert by.slope == pytest.approx(0.7, abs=0.05)
    assert by.offset == pytest.approx(-1.0, abs=0.06)


@pytest.mark.slow
def test_train_commands_produce_a_checkpoint_from_simulated_pictures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames, out = tmp_path / "frames", tmp_path / "mine.safetensors"
    assert (
        run(["train", "frames", "L3", "--per-layout", "4", "--width", "320", "-o", str(frames)])
        == 0
    )
    learn = (
        f"train mask-rcnn --data {frames / 'coco.json'} --images {frames / 'images'} -o "
        f"{out} --width 320 --steps 2 --batch 1 --window 128 64 --check-every 1 "
        "--check-images 1"
    ).split()

    assert run(learn) == 0

    reported = capsys.readouterr().out
    assert "step 2 of 2" in reported
    checkpoint = load_checkpoint(out)
    assert checkpoint.facts.plan.classes == ("car", "stop sign", "traffic light")
    assert checkpoint.facts.recipe["schedule.steps"] == 2
    assert [row["step"] for row in json.loads(out.with_suffix(".curve.json").read_text())] == [1, 2]
    assert cv2.imread(str(out.with_suffix(".curve.png"))) is not None
    assert not out.with_suffix(".state.safetensors").exists()
    assert run(learn) == 1
    assert "--overwrite starts over" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["-o", "x.pth"], "ends in .safetensors"),
        (["--steps", "0"], "--steps: expected 1 or more"),
        (["--learning-rate", "nan"], "--learning-rate"),
        (["--window", "100", "64"], "multiples of 32"),
        (["--window", "64", "1000000000"], "multiples of 32 from 64 to 4096"),
        (["--classes", "car", "car"], "is empty or repeated"),
        (["--classes", ""], "empty or repeated"),
        (["--width", "10"], "width_px: input should be greater than or equal to 64"),
        (["--measure", "embedded"], "cannot be combined with -o"),
        (["--val-data", "x.json"], "expected both or neither"),
        (["--crop-top", "0.6", "--crop-bottom", "0.6"], "less than a tenth"),
    ],
)
def test_invalid_flags_are_reported_before_training(
    tmp_path: Path, flags: list[str], message: str
) -> None:
    path = write_bars(tmp_path / "set", 11)
    base = (
        f"train mask-rcnn --data {path} --images {path.parent / 'images'} -o "
        f"{tmp_path / 'out.safetensors'}"
    ).split()

    assert message in refusal(2, *base, *flags)


def test_box_beyond_the_picture_is_clipped_and_counted(tmp_path: Path) -> None:
    labelled = _changed(tmp_path, annotations=_with({"bbox": [-10, -5, 30, 300]}))

    assert labelled.pictures[0].objects[0].box_px == (0.0, 0.0, 20.0, 96.0)
    assert labelled.left_out == {"boxes cut off at the picture's edge": 1}


def test_state_of_other_settings_or_damaged_state_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "state.safetensors"
    one, _ = _training(tmp_path / "a", Schedule(4, batch=2))
    one.save(path, {})
    other, _ = _training(tmp_path / "b", Schedule(5, batch=2))

    with pytest.raises(SchemaError, match="training with other settings"):
        other.resume(path)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(SchemaError, match="damaged"):
        one.resume(path)


@pytest.mark.slow
def test_nan_loss_ends_the_training(tmp_path: Path) -> None:
    training, sampler = _training(tmp_path, Schedule(40, batch=1))
    with torch.no_grad():
        training.network.rpn.head.cls_logits.bias.fill_(float("nan"))

    with pytest.raises(CrosscueError, match="lower --learning-rate"):
        list(training.steps(sampler))


@pytest.mark.slow
def test_train_mask_rcnn_measures_a_network_without_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = tmp_path / "frames"
    run(["train", "frames", "L901", "--per-layout", "3", "-o", str(frames), "-q"])
    base = (
        f"train mask-rcnn --measure embedded --data {frames / 'coco.json'} --images "
        f"{frames / 'images'}"
    ).split()

    assert run([*base, "--subset", "1:", "--proposals", "100", "200", "--json"]) == 0
    tree = json.loads(capsys.readouterr().out)
    assert tree["pictures"] == 2
    assert [row["proposals"] for row in tree["measured"]] == [100, 200]
    first = tree["measured"][0]
    assert 0.0 < first["ap"]["box"] <= 100.0
    by_score = [row for row in first["rates"] if row["label"] == "car"]
    assert [row["score"] for row in by_score] == [0.5, 0.9, 0.95]
    assert [row["found"] for row in by_score] == sorted(
        (row["found"] for row in by_score), reverse=True
    )

    assert run(base) == 0
    reported = capsys.readouterr().out
    assert "embedded on 3 pictures, 100 proposals" in reported
    assert "score from 0.95" in reported


def test_picture_of_another_size_than_annotated_is_refused(tmp_path: Path) -> None:
    labelled = _changed(tmp_path, images=_with({"width": 130, "height": 97}))
    sampler = Sampler(labelled, plan_of(), WINDOW, 0)

    with pytest.raises(SchemaError, match=r"0\.png: expected a picture of 130 x 97"):
        [sampler(number) for number in range(20)]


MASK_HEAD = ("roi_heads.mask_head.", "roi_heads.mask_predictor.")


def _mask_head(network: Any) -> dict[str, torch.Tensor]:
    return {
        name: value.clone()
        for name, value in network.state_dict().items()
        if name.startswith(MASK_HEAD)
    }


@pytest.mark.slow
def test_previously_trained_mask_head_keeps_its_masks(tmp_path: Path) -> None:
    masked = MaskRcnnTrainingSettings(
        data=write_bars(tmp_path / "a", 2),
        images=tmp_path / "a" / "images",
        classes=["car"],
        steps=1,
        batch=1,
        width_px=128,
        window_px=(96, 64),
        device="cpu",
    )
    first = crosscue.train_mask_rcnn(masked, tmp_path / "first.safetensors")
    bare = write_bars(tmp_path / "b", 2)
    tree = json.loads(bare.read_text())
    for row in tree["annotations"]:
        del row["segmentation"]
    bare.write_text(json.dumps(tree))
    later = replace(masked, data=bare, images=tmp_path / "b" / "images", init=first.path)

    second = crosscue.train_mask_rcnn(later, tmp_path / "second.safetensors")

    heads = [_mask_head(load_checkpoint(one.path).network) for one in (first, second)]
    assert second.facts.has_masks
    assert all(torch.equal(value, heads[1][name]) for name, value in heads[0].items())
    assert "no masks" in repr(second)


ROAD = "road --data set --steps 2 --batch 2 --width 128"
MASKS = (
    "mask-rcnn --data bars/coco.json --images bars/images --classes car --steps 2 --batch 2 "
    "--width 128 --window 96 64"
)
RUN = [
    f"train {line} --device cpu --threads 2 -o {line.split()[0]}.safetensors -q".split()
    for line in (ROAD, MASKS)
]
CHILD = f"from crosscue.eval.cli import run\nassert not any(map(run, {RUN!r}))"


def _road_set(folder: Path, numbers: list[int]) -> None:
    """Write pictures and masks in this order, which is often that of the folder's entries."""
    for name in ("images", "masks"):
        (folder / "set" / name).mkdir(parents=True)
    for number in numbers:
        shade = picture(number, ".png", 160, 96)
        (folder / "set" / "images" / f"{number}.png").write_bytes(shade)
        mask = picture(29 * (number % 2), ".png", 160, 96)
        (folder / "set" / "masks" / f"{number}.png").write_bytes(mask)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Folders of two processes, this and another, that each train both networks."""
    made = []
    for numbers in ([0, 1, 2, 3], [3, 1, 0, 2]):
        folder = tmp_path_factory.mktemp("trained")
        _road_set(folder, numbers)
        write_bars(folder / "bars", 4)
        made.append(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(made[0])
        assert not any(map(run, RUN))
    # Text has another hash here.
    env = os.environ | {"PYTHONHASHSEED": "2"}
    command = [sys.executable, "-c", CHILD]
    subprocess.run(command, cwd=made[1], env=env, check=True, timeout=300)
    return made


@pytest.mark.slow
@pytest.mark.parametrize("network", ["road", "mask-rcnn"])
def test_two_trainings_write_identical_files(folders: list[Path], network: str) -> None:
    one, other = (folder.joinpath(f"{network}.safetensors").read_bytes() for folder in folders)

    assert one == other
