"""Tests that each Mask R-CNN back end returns the detections of torchvision's network."""

import copy
import os
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.networks.mask_rcnn.checkpoint import Checkpoint, Facts
from crosscue.detectors.networks.mask_rcnn.cpu import MIN_PIXELS, Halved, Winograd, for_cpu
from crosscue.detectors.networks.mask_rcnn.detector import (
    MaskRcnnDetector,
    MaskRcnnSettings,
    ScreenedParts,
    detector_of,
    laid_in,
    place_picture,
)
from crosscue.detectors.networks.mask_rcnn.network import build_network
from crosscue.detectors.networks.mask_rcnn.parts import TorchParts, as_input
from support.commands import python
from support.mask_rcnn import CPU, noise_frame, plan_of, random_checkpoint

BACKENDS = ("torch", "openvino")
SCORE = 0.4


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """Use one thread, because torch's threads spin while waiting and slow down parallel tests."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def _needs(backend: str) -> None:
    # An import here would load the telemetry of openvino; crosscue's own import prevents that.
    if find_spec(backend) is None:
        pytest.skip(f"the extra {backend} is not installed")


def _detector(checkpoint: Checkpoint, backend: str, **changes: Any) -> MaskRcnnDetector:
    """Build a detector without calibration, so that scores are the network's."""
    _needs(backend)
    bare = Checkpoint(Facts(plan=checkpoint.facts.plan), checkpoint.network, checkpoint.sha256)
    asked = {"score": SCORE, "proposals": 1000, "backend": backend, **changes}
    return detector_of(bare, MaskRcnnSettings.model_validate(asked), CPU)


def _found(detector: MaskRcnnDetector, frame: Frame) -> Detections:
    (found,) = detector([frame])
    assert isinstance(found, Detections)
    return found


@cache
def _torchvision(network: Any, objectness: float = 0.0) -> Any:
    """Copy the network, with torchvision's number of proposals and uncalibrated scores."""
    own = copy.deepcopy(network).eval()
    own.rpn._pre_nms_top_n["testing"] = own.rpn._post_nms_top_n["testing"] = 1000
    own.rpn.score_thresh = objectness
    own.roi_heads.score_thresh = 0.05
    own.transform = nn.Identity()
    return own


def _found_by_torchvision(checkpoint: Checkpoint, frame: Frame) -> Detections:
    """Run torchvision's modules in torchvision's order; keep detections above the score."""
    from torchvision.models.detection.image_list import ImageList

    plan = checkpoint.facts.plan
    placed = place_picture(frame.pixels, plan)
    network = _torchvision(checkpoint.network, 0.0)
    with torch.inference_mode():
        pictures = as_input(placed.pixels[None], CPU)
        sizes = [(int(pictures.shape[2]), int(pictures.shape[3]))]
        levels = network.backbone(pictures)
        proposals, _ = network.rpn(ImageList(pictures, sizes), levels)
        ((found,), _) = network.roi_heads(levels, proposals, sizes)
    keep = found["scores"] >= SCORE
    boxes = (found["boxes"][keep].double().numpy() + np.tile(placed.corner_px, 2)) / np.tile(
        placed.scale, 2
    )
    masks = found["masks"][keep][:, 0].numpy()
    return Detections(
        frame.t_ns,
        frame.size_px,
        boxes,
        found["scores"][keep].double().numpy(),
        tuple(str(plan.classes[i - 1]) for i in found["labels"][keep].tolist()),
        tuple(laid_in(m, b, frame.size_px) for m, b in zip(masks, boxes, strict=True)),
    )


def _assert_equal(ours: Detections, theirs: Detections) -> None:
    """Assert equal classes, boxes within half a pixel, and masks except for a few edge pixels."""
    assert len(ours) == len(theirs)
    free = set(range(len(ours)))
    for i, label in enumerate(theirs.labels):
        apart_px = {j: float(np.abs(ours.boxes_px[j] - theirs.boxes_px[i]).max()) for j in free}
        j = min(apart_px, key=apart_px.__getitem__)
        free.remove(j)
        assert ours.labels[j] == label
        assert apart_px[j] <= 0.5
        assert ours.scores[j] == pytest.approx(theirs.scores[i], abs=1e-3)
        mine, other = (
            rle.decode_mask(one, ours.size_px) for one in (ours.masks[j], theirs.masks[i])
        )
        assert int((mine ^ other).sum()) <= 4 + 0.01 * int(other.sum())


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("seed", [0, 7])
def test_random_weights_match_torchvision(backend: str, seed: int) -> None:
    checkpoint = random_checkpoint(seed)
    detector = _detector(checkpoint, backend)
    found = 0
    for picture in range(2):
        frame = noise_frame(picture)
        theirs = _found_by_torchvision(checkpoint, frame)
        _assert_equal(_found(detector, frame), theirs)
        found += len(theirs)
    assert found > 10


@settings(max_examples=10)
@given(
    st.integers(48, 80),
    st.integers(48, 80),
    st.integers(1, 40),
    st.integers(1, 40),
    st.integers(1, 2),
    st.booleans(),
)
def test_winograd_convolution_matches_direct_convolution(
    inputs: int, outputs: int, height: int, width: int, count: int, has_bias: bool
) -> None:
    torch.manual_seed(inputs * outputs)
    plain = nn.Conv2d(inputs, outputs, 3, padding=1, bias=has_bias)
    x = torch.randn(count, inputs, height, width)

    with torch.inference_mode():
        wanted = plain.double()(x.double())
        got = Winograd(plain.float())(x)

    np.testing.assert_allclose(got.numpy(), wanted.numpy(), atol=1e-4)


@settings(max_examples=15)
@given(st.integers(1, 9), st.integers(1, 9))
def test_sliced_average_pooling_matches_torch(height: int, width: int) -> None:
    plain = nn.AvgPool2d(2, ceil_mode=True)
    x = torch.randn(2, 3, height, width)

    np.testing.assert_allclose(Halved(plain)(x).numpy(), plain(x).numpy(), atol=1e-6)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_screening_keeps_all_detections_above_the_score(noise: float) -> None:
    torch.manual_seed(4)
    network = build_network(plan_of()).eval()
    heads = network.roi_heads
    with torch.no_grad():
        # A first layer that low-rank matrices approximate, and a noisy one that they do not.
        first = heads.box_head.fc6.weight
        thin = torch.randn(256, 8) @ torch.randn(8, first.shape[1])
        first.copy_(0.02 * (thin + 10.0 * noise * torch.randn(first.shape)))
        heads.box_predictor.cls_score.weight.mul_(4.0)
    heads.score_thresh = SCORE
    pooled = torch.randn(500, 64, 7, 7).contiguous(memory_format=torch.channels_last)

    with torch.inference_mode():
        ours, our_shifts = ScreenedParts(network).boxes(pooled)
        logits, shifts = TorchParts(network, CPU).boxes(pooled)

    mine, other = (torch.softmax(of, 1)[:, 1:].amax(1) for of in (ours, logits))
    found = other >= SCORE
    assert 10 < int(found.sum()) < 490
    assert torch.equal(mine >= SCORE, found)
    np.testing.assert_allclose(ours[found].numpy(), logits[found].numpy(), atol=1e-3)
    np.testing.assert_allclose(our_shifts[found].numpy(), shifts[found].numpy(), atol=1e-3)
    assert bool((our_shifts == 0.0).all(1).any()) == (noise == 0.0)


def test_cpu_copy_matches_the_original_and_leaves_it_unchanged() -> None:
    torch.manual_seed(3)
    network = build_network(plan_of())
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            assert module.running_mean is not None
            assert module.running_var is not None
            module.running_mean.normal_(0.0, 0.1)
            module.running_var.uniform_(0.5, 2.0)
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.bias)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    pictures = np.random.default_rng(0).integers(0, 256, (2, 192, 256, 3), np.uint8)

    own = for_cpu(network.eval())
    with torch.inference_mode():
        ours = TorchParts(own, CPU).body(pictures)
        theirs = TorchParts(network, CPU).body(pictures)

    assert any(isinstance(m, Winograd) for m in own.modules())
    assert any(isinstance(m, Halved) for m in own.modules())
    assert not any(isinstance(m, nn.BatchNorm2d) for m in own.modules())
    assert MIN_PIXELS <= (192 // 8) * (256 // 8)
    for ours_of, theirs_of in zip(ours, theirs, strict=True):
        for mine, other in zip(ours_of, theirs_of, strict=True):
            np.testing.assert_allclose(mine.numpy(), other.numpy(), rtol=1e-3, atol=1e-4)
    after = network.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in before.items())


_WATCHED = """
import os, sys

def watch(event, given):
    if event in ("os.fork", "socket.connect", "urllib.Request", "subprocess.Popen"):
        # An exception would be lost in the thread that sends.
        os.write(2, f"{event} {given}".encode())
        os._exit(3)

import numpy as np
from crosscue.detectors.base import Frame
from crosscue.detectors.networks.mask_rcnn.detector import build

sys.addaudithook(watch)
build(backend="openvino")([Frame(0, "", np.zeros((64, 128, 3), np.uint8), (128, 64))])
assert "openvino.tools.ovc.telemetry_stub" in sys.modules
"""


@pytest.mark.slow
def test_openvino_sends_no_telemetry_and_writes_no_home_files(tmp_path: Path) -> None:
    _needs("openvino")
    hidden = {"CI", "TF_BUILD", "JENKINS_URL"}
    around = {k: v for k, v in os.environ.items() if k not in hidden}

    done = python(_WATCHED, env={**around, "HOME": str(tmp_path)})

    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "intel").exists()
