"""Tests of training without masks: boxes are trained, and the mask head remains unchanged."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

import crosscue
from crosscue.detectors.networks.mask_rcnn.checkpoint import load_checkpoint
from crosscue.eval.training.mask_rcnn import MaskRcnnTrainingSettings
from support.mask_rcnn import write_bars

MASK_HEAD = ("roi_heads.mask_head.", "roi_heads.mask_predictor.")


def _without_masks(path: Path, every: int = 1) -> None:
    """Remove the mask of each annotation, or of every ``every``-th."""
    tree = json.loads(path.read_text())
    for row in tree["annotations"][::every]:
        row.pop("segmentation", None)
    path.write_text(json.dumps(tree))


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
    _without_masks(bare)
    later = MaskRcnnTrainingSettings(
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
