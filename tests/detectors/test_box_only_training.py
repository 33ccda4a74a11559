"""Tests of training without masks: boxes are trained, and the mask head remains unchanged."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import crosscue
from crosscue.detectors.networks.mask_rcnn.checkpoint import load_checkpoint
from crosscue.detectors.networks.mask_rcnn.network import build_network
from crosscue.detectors.training.annotations import LabelledSet, mask_of, read_training_coco
from crosscue.detectors.training.loop import Schedule, Training
from crosscue.detectors.training.samples import Sampler, SampleSettings
from crosscue.eval.cli import run
from support.mask_rcnn import CPU, plan_of, write_bars

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


@pytest.mark.slow
def test_mixed_data_trains_the_mask_head(tmp_path: Path) -> None:
    training, sampler = _training(_boxes(tmp_path, every=2), Schedule(2, batch=4, warm_up=1))
    before = _mask_head(training.network)

    list(training.steps(sampler))

    after = _mask_head(training.network)
    assert any(not torch.equal(value, after[name]) for name, value in before.items())


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
