"""Tests of training without masks: boxes are trained, and the mask head remains unchanged."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import crosscue
from crosscue.detectors import rle
from crosscue.detectors.base import Detections
from crosscue.detectors.networks.mask_rcnn.checkpoint import Checkpoint, Facts, load_checkpoint
from crosscue.detectors.networks.mask_rcnn.detector import MaskRcnnSettings, detector_of
from crosscue.detectors.networks.mask_rcnn.network import build_network
from crosscue.detectors.training.annotations import LabelledSet, mask_of, read_training_coco
from crosscue.detectors.training.loop import Schedule, Training
from crosscue.detectors.training.samples import Sampler, SampleSettings
from crosscue.detectors.training.scores import average_precisions
from crosscue.eval.cli import run
from support.mask_rcnn import CPU, noise_frame, plan_of, random_checkpoint, write_bars

WINDOW = SampleSettings(96, 64)
MASK_HEAD = ("roi_heads.mask_head.", "roi_heads.mask_predictor.")


def _without_masks(path: Path, every: int = 1) -> None:
    """Remove the mask of each annotation, or of every ``every``-th."""
    tree = json.loads(path.read_text())
    for row in tree["annotations"][::every]:
        row.pop("segmentation", None)
    path.write_text(json.dumps(tree))


def _boxes(folder: Path, every: int = 1, count: int = 4) -> LabelledSet:
    path = write_bars(folder / "set", count)
    _without_masks(path, every)
    return read_training_coco(path, folder / "set" / "images", ("car",))


def _training(labelled: LabelledSet, schedule: Schedule) -> tuple[Training, Sampler]:
    plan = plan_of()
    training = Training(lambda: build_network(plan), schedule, CPU, learns_masks=labelled.masks > 0)
    return training, Sampler(labelled, plan, WINDOW, schedule.seed)


def _mask_head(network: Any) -> dict[str, torch.Tensor]:
    return {
        name: value.clone()
        for name, value in network.state_dict().items()
        if name.startswith(MASK_HEAD)
    }


@pytest.mark.parametrize("absent", [None, []])
def test_annotation_without_mask_is_read(tmp_path: Path, absent: object) -> None:
    path = write_bars(tmp_path, 2)
    tree = json.loads(path.read_text())
    tree["annotations"][0]["segmentation"] = absent
    path.write_text(json.dumps(tree))

    labelled = read_training_coco(path, tmp_path / "images", ("car",))

    assert (labelled.objects, labelled.masks, labelled.left_out) == (4, 3, {})
    one = labelled.pictures[0].objects[0]
    rows, columns = np.nonzero(mask_of(one, (128, 96)))
    assert one.box_px == (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)


def test_sample_marks_objects_with_a_mask(tmp_path: Path) -> None:
    sampler = Sampler(_boxes(tmp_path, every=2), plan_of(), WINDOW, 0)

    marks = np.concatenate([sampler(number).has_mask for number in range(12)])

    assert marks.any()
    assert not marks.all()


@pytest.mark.slow
def test_training_without_masks_keeps_the_mask_head(tmp_path: Path) -> None:
    training, sampler = _training(_boxes(tmp_path), Schedule(16, batch=2, rate=2e-3, warm_up=4))
    before = _mask_head(training.network)

    losses = [loss for _, loss in training.steps(sampler)]

    assert np.mean(losses[-4:]) < 0.85 * np.mean(losses[:3])
    assert before
    for network in (training.network, training.averaged):
        after = _mask_head(network)
        assert all(torch.equal(value, after[name]) for name, value in before.items())


@pytest.mark.slow
def test_mixed_data_trains_the_mask_head(tmp_path: Path) -> None:
    training, sampler = _training(_boxes(tmp_path, every=2), Schedule(2, batch=4, warm_up=1))
    before = _mask_head(training.network)

    list(training.steps(sampler))

    after = _mask_head(training.network)
    assert any(not torch.equal(value, after[name]) for name, value in before.items())


def test_mask_precision_counts_only_objects_with_a_mask(tmp_path: Path) -> None:
    path = write_bars(tmp_path, 2)
    whole = read_training_coco(path, tmp_path / "images", ("car",))
    _without_masks(path, every=2)
    mixed = read_training_coco(path, tmp_path / "images", ("car",))
    _without_masks(path)
    boxes = read_training_coco(path, tmp_path / "images", ("car",))

    found = []
    for number, picture in enumerate(whole.pictures):
        # Objects without a mask in the mixed data have wrong masks here: half of the object.
        masks = []
        for k, one in enumerate(picture.objects):
            mask = mask_of(one, picture.size_px)
            if k % 2 == 0:
                mask[:, : int(one.box_px[0] + one.box_px[2]) // 2] = False
            masks.append(rle.encode_mask(mask, (0, 0), picture.size_px))
        corners = np.array([one.box_px for one in picture.objects], np.float64)
        found.append(
            Detections(
                number, picture.size_px, corners, np.full(2, 0.9), ("car",) * 2, tuple(masks)
            )
        )

    assert average_precisions(whole, found)["mask"] != 100.0
    mixed_scores = average_precisions(mixed, found)
    assert mixed_scores["box"] == mixed_scores["mask"] == 100.0
    box_scores = average_precisions(boxes, found)
    assert (box_scores["box"], box_scores["mask"], box_scores["mask50"]) == (100.0, None, None)


def test_network_without_trained_mask_head_returns_no_masks() -> None:
    known = random_checkpoint()
    facts = Facts(plan=known.facts.plan, has_masks=False)
    boxes_only = Checkpoint(facts, known.network, "boxes_only")
    settings = MaskRcnnSettings(score=0.0, proposals=20)

    (masked,) = detector_of(known, settings, CPU)([noise_frame()])
    (bare,) = detector_of(boxes_only, settings, CPU)([noise_frame()])

    assert isinstance(bare, Detections)
    assert isinstance(masked, Detections)
    assert len(bare) == len(masked) > 0
    assert np.array_equal(bare.boxes_px, masked.boxes_px)
    assert set(bare.masks) == {b""}


@pytest.mark.slow
@pytest.mark.parametrize(("every", "has_masks", "bare"), [(1, False, 6), (2, True, 3)])
def test_recipe_records_the_number_of_boxes_without_mask(
    every: int, has_masks: bool, bare: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_bars(tmp_path, 4)
    _without_masks(path, every)
    out = tmp_path / "net.safetensors"
    line = f"train mask-rcnn --data {path} --images {tmp_path}/images -o {out} --classes car"
    flags = "--steps 1 --batch 1 --check-every 1 --window 96 64 --width 128 --device cpu"

    assert run(f"{line} {flags}".split()) == 0

    printed = capsys.readouterr().out
    facts = load_checkpoint(out).facts
    assert (facts.recipe["objects"], facts.recipe["boxes_without_mask"]) == (6, bare)
    assert facts.has_masks is has_masks
    assert f"training: 3 pictures, {bare} of 6 objects without a mask" in printed
    assert ("mask AP" in printed) is has_masks


@pytest.mark.slow
def test_previously_trained_mask_head_keeps_its_masks(tmp_path: Path) -> None:
    masked = crosscue.MaskRcnnTrainingSettings(
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
    _without_masks(bare)
    later = crosscue.MaskRcnnTrainingSettings(
        data=bare,
        images=tmp_path / "b" / "images",
        init=first.path,
        classes=["car"],
        steps=1,
        batch=1,
        width_px=128,
        window_px=(96, 64),
        device="cpu",
    )

    second = crosscue.train_mask_rcnn(later, tmp_path / "second.safetensors")

    heads = [_mask_head(load_checkpoint(one.path).network) for one in (first, second)]
    assert second.facts.has_masks
    assert all(torch.equal(value, heads[1][name]) for name, value in heads[0].items())
    assert "no masks" in repr(second)
