"""Tests of the Mask R-CNN detector: agreement with torchvision, batches, and checkpoints."""

import io
import pickle
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import save
from torch import Tensor, nn
from torchvision.models.detection.roi_heads import paste_masks_in_image

from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.boxes import box_ious
from crosscue.detectors.networks.mask_rcnn.checkpoint import (
    KEY,
    Calibration,
    Checkpoint,
    Facts,
    load_checkpoint,
    save_checkpoint,
)
from crosscue.detectors.networks.mask_rcnn.coco import COCO_NETWORKS, coco_checkpoint
from crosscue.detectors.networks.mask_rcnn.detector import (
    MaskRcnnDetector,
    MaskRcnnSettings,
    build,
    calibrated,
    detector_of,
    laid_in,
    raw_score,
)
from crosscue.detectors.networks.mask_rcnn.parts import Body, MaskRcnnLayers
from crosscue.detectors.weights_file import SUM
from crosscue.replay.columns import Bytes
from crosscue.replay.errors import VehicleError
from support.mask_rcnn import CPU, noise_frame, plan_of, random_checkpoint
from support.scenes import picture_at, world


def _detector(checkpoint: Checkpoint | None = None, **changes: Any) -> MaskRcnnDetector:
    asked = MaskRcnnSettings.model_validate({"score": 0.4, **changes})
    return detector_of(random_checkpoint() if checkpoint is None else checkpoint, asked, CPU)


def _found(detector: MaskRcnnDetector, *frames: Frame) -> list[Detections]:
    found = detector(frames)
    assert all(isinstance(one, Detections) for one in found)
    return [one for one in found if isinstance(one, Detections)]


def _equal(one: Detections, other: Detections) -> bool:
    return (
        np.array_equal(one.boxes_px, other.boxes_px)
        and np.array_equal(one.scores, other.scores)
        and (one.labels, one.masks) == (other.labels, other.masks)
    )


def test_grey_picture_equals_picture_with_equal_channels() -> None:
    frame = noise_frame()
    grey = np.asarray(cv2.cvtColor(frame.pixels, cv2.COLOR_BGR2GRAY), np.uint8)
    coloured = np.repeat(grey[:, :, None], 3, axis=2)

    (one,) = _found(_detector(), replace(frame, pixels=grey))
    (other,) = _found(_detector(), replace(frame, pixels=coloured))

    assert _equal(one, other)


@dataclass
class _Small:
    """Back end of a device with memory for a limited number of pictures."""

    within: MaskRcnnLayers
    max_count: int
    tried: list[int] = field(default_factory=list)

    def body(self, pictures: Bytes, /) -> Body:
        self.tried.append(len(pictures))
        if len(pictures) > self.max_count:
            raise torch.OutOfMemoryError("no memory")
        return self.within.body(pictures)

    def boxes(self, pooled: Tensor, /) -> tuple[Tensor, Tensor]:
        return self.within.boxes(pooled)

    def masks(self, pooled: Tensor, /) -> Tensor:
        return self.within.masks(pooled)


def _with_memory(max_count: int) -> tuple[MaskRcnnDetector, _Small]:
    plenty = _detector(batch=8)
    small = _Small(plenty.parts, max_count)
    return replace(plenty, parts=small), small


def test_batch_shrinks_when_device_memory_runs_out() -> None:
    frames = [noise_frame(k, t_ns=k) for k in range(9)]
    detector, small = _with_memory(2)

    found = _found(detector, *frames)

    assert small.tried == [8, 4, 2, 2, 2, 2, 1]
    assert [one.t_ns for one in found] == list(range(9))
    np.testing.assert_allclose(
        found[8].boxes_px, _found(_detector(), frames[8])[0].boxes_px, atol=1e-3
    )


def test_identity_changes_with_every_setting_that_affects_results() -> None:
    base = _detector().identity
    other = replace(random_checkpoint(), sha256="other")

    assert _detector().identity == base
    assert _detector(threads=2, batch=3).identity == base
    assert _detector(score=0.41).identity != base
    assert _detector(proposals=50).identity != base
    assert _detector(objectness=0.01).identity != base
    assert _detector(other).identity != base


@given(st.floats(0.02, 0.98), st.floats(0.02, 0.98), st.floats(0.2, 4.0), st.floats(-4.0, 4.0))
def test_calibration_is_monotonic_and_invertible(
    one: float, other: float, slope: float, offset: float
) -> None:
    by = Calibration(slope=slope, offset=offset)

    assert raw_score(calibrated(one, by), by) == pytest.approx(one, abs=1e-4)
    low, high = sorted((one, other))
    assert calibrated(low, by) <= calibrated(high, by) + 1e-12
    assert 0.0 <= calibrated(one, by) <= 1.0


@given(
    st.integers(-20, 90),
    st.integers(-20, 60),
    st.integers(8, 120),
    st.integers(8, 90),
    st.floats(0.5, 1.0),
)
def test_mask_in_its_box_matches_torchvision(
    x: int, y: int, width: int, height: int, fullness: float
) -> None:
    box = np.clip(np.array([x, y, x + width, y + height], np.float64), 0, [128, 96, 128, 96])
    if (box[2:] - box[:2] < 8).any():
        return
    at = (np.arange(28) + 0.5) / 14.0 - 1.0
    mask = (np.hypot(at[:, None], at[None, :]) < fullness).astype(np.float32)

    # Torchvision widens the box by a rim of one cell of the mask, and rounds that to whole pixels.
    rim = (box[2:] - box[:2]) / 28.0
    first = np.trunc(box[:2] - rim)
    size = np.trunc(box[2:] + rim) - first + 1.0
    rounded = np.concatenate([first + size / 30.0, first + size * 29.0 / 30.0])
    ours = rle.decode_mask(laid_in(mask, rounded, (128, 96)), (128, 96))
    pasted = paste_masks_in_image(
        torch.from_numpy(mask)[None, None], torch.from_numpy(box).float()[None], (96, 128)
    )
    probability = pasted[0, 0].numpy()

    sure = np.abs(probability - 0.5) > 1e-5
    assert (ours == (probability > 0.5))[sure].all()


def _file(tmp_path: Path, facts: str | None, tensors: dict[str, Tensor] | None = None) -> Path:
    path = tmp_path / "own.safetensors"
    weights = {k: v.contiguous() for k, v in random_checkpoint().network.state_dict().items()}
    header = {} if facts is None else {KEY: facts}
    path.write_bytes(save(weights if tensors is None else tensors, header))
    return path


@cache
def _written() -> bytes:
    plain = random_checkpoint()
    with TemporaryDirectory() as name:
        path = Path(name) / "one.safetensors"
        save_checkpoint(path, plain.network, plain.facts)
        return path.read_bytes()


def _json(**changes: Any) -> str:
    return Facts(plan=plan_of(**changes)).model_dump_json()


def test_nan_weights_are_refused(tmp_path: Path) -> None:
    tensors = {
        k: v.contiguous().clone() for k, v in random_checkpoint().network.state_dict().items()
    }
    tensors["rpn.head.cls_logits.bias"][0] = float("nan")

    with pytest.raises(VehicleError, match=r"cls_logits\.bias: holds values that are not finite"):
        load_checkpoint(_file(tmp_path, _json(), tensors))


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        (None, "has no description of classes"),
        ("{}", "plan: field required"),
        ("no json", "is invalid"),
        (_json().replace("compact", "alexnet"), "plan.architecture"),
        (_json().replace("128", "999999"), "plan.width_px"),
        ('{"version": 99, "plan": ' + plan_of().model_dump_json() + "}", "version"),
    ],
)
def test_checkpoint_with_an_invalid_description_is_refused(
    tmp_path: Path, facts: str | None, message: str
) -> None:
    with pytest.raises(VehicleError, match=message):
        load_checkpoint(_file(tmp_path, facts))


class _Malicious:
    """Object that creates a folder when it is unpickled."""

    def __init__(self, where: Path) -> None:
        self.where = where

    def __reduce__(self) -> Any:
        return Path.mkdir, (self.where,)


@pytest.mark.parametrize("suffix", [".pth", ".pt", ".pkl", ".bin", ".ckpt", ".safetensors"])
def test_malicious_pickle_is_refused_and_not_executed(tmp_path: Path, suffix: str) -> None:
    trap = tmp_path / "sprung"
    content = pickle.dumps(_Malicious(trap))
    if suffix == ".pt":
        buffer = io.BytesIO()
        torch.save(_Malicious(trap), buffer)
        content = buffer.getvalue()
    path = tmp_path / f"weights{suffix}"
    path.write_bytes(content)

    with pytest.raises(VehicleError, match=r"expected \.safetensors|not a safetensors file"):
        build(network=str(path))

    assert not trap.exists()


@given(at=st.floats(0.0, 1.0), bit=st.integers(0, 7))
def test_flipped_bit_in_a_checkpoint_is_refused(at: float, bit: int) -> None:
    content = bytearray(_written())
    place = round(at * (len(content) - 1))
    content[place] ^= 1 << bit
    with TemporaryDirectory() as name:
        path = Path(name) / "flipped.safetensors"
        path.write_bytes(content)
        # A flipped bit in the checksum's name yields a file without checksum, which is valid.
        if SUM.encode() in content:
            with pytest.raises(VehicleError, match="flipped"):
                load_checkpoint(path)


def test_damaged_coco_weights_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    (folder / "maskrcnn_resnet50_fpn_coco-bf2d0c1e.pth").write_bytes(b"half of it")

    with pytest.raises(VehicleError, match=r"damaged: sha256 .*, expected bf2d0c1e.*delete it"):
        build(network="resnet50")


@pytest.mark.parametrize("name", ["resnet50", "resnet50-v2"])
def test_coco_weights_yield_the_feature_levels_of_torchvision(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from torchvision.models import detection

    weights = getattr(detection, COCO_NETWORKS[name]).DEFAULT
    make = {
        "resnet50": detection.maskrcnn_resnet50_fpn,
        "resnet50-v2": detection.maskrcnn_resnet50_fpn_v2,
    }[name]
    with torch.device("meta"):
        empty = make(weights=None, weights_backbone=None).state_dict()
    torch.manual_seed(0)
    # Variances so small that an epsilon of 1e-5 has an effect.
    state = {
        key: torch.full(value.shape, 1e-4)
        if key.endswith("running_var")
        else torch.zeros(value.shape, dtype=value.dtype)
        if "tracked" in key
        else torch.randn(value.shape) * 0.03
        for key, value in empty.items()
    }
    monkeypatch.setattr(
        "torchvision.models._api.load_state_dict_from_url", lambda *args, **given: dict(state)
    )
    monkeypatch.setattr(nn.init, "kaiming_uniform_", lambda tensor, **given: tensor)
    picture = torch.randn(1, 3, 64, 64)

    with torch.inference_mode():
        theirs = make(weights=weights, progress=False).eval().backbone(picture)
        ours = coco_checkpoint(name, weights, state).network.backbone(picture)

    for level, value in theirs.items():
        largest = float(value.abs().max())
        assert largest > 0.0
        assert float((ours[level] - value).abs().max()) < 1e-3 * largest


@pytest.mark.slow
@pytest.mark.parametrize(
    ("layout", "x_m", "category", "label"),
    [
        ("A", -20.0, "stop_sign", "stop sign"),
        ("E", -25.0, "traffic_light", "traffic light"),
        ("C", -15.0, "car", "car"),
    ],
)
def test_embedded_checkpoint_detects_objects_of_unseen_layouts(
    layout: str, x_m: float, category: str, label: str
) -> None:
    picture = picture_at(world(layout), x_m, SceneCamera())
    largest = max(
        (one for one in picture.seen if one.thing.category == category),
        key=lambda one: int(one.mask.sum()),
    )
    frame = Frame(0, "", np.ascontiguousarray(picture.rgb[:, :, ::-1]), (1280, 720))

    (found,) = build(device="cpu")([frame])

    assert isinstance(found, Detections)
    kept = [i for i, name in enumerate(found.labels) if name == label]
    fraction = box_ious(np.array(largest.box_px, np.float64), found.boxes_px[kept])
    assert fraction.max() > 0.5
    best = kept[int(fraction.argmax())]
    x0, y0, x1, y1 = largest.box_px
    mask = rle.decode_mask(found.masks[best], (1280, 720))[y0:y1, x0:x1]
    assert (mask & largest.mask).sum() > 0.6 * (mask | largest.mask).sum()
