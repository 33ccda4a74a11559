"""Tests of torchvision weights: recognition by their tensors, and torchvision's results."""

import argparse
import io
import os
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

import crosscue
from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.catalog.architectures import ARCHITECTURES, ArchitectureName
from crosscue.detectors.catalog.card import read_card
from crosscue.detectors.networks.devices import threads_of
from crosscue.detectors.networks.model_detector import build
from crosscue.eval.cli import run
from support.mask_rcnn import NAMES, class_names, hollow, network
from support.refusals import refusal

SIZE = (160, 96)
SSDLITE = "ssdlite320_mobilenet_v3_large"
MEAN = "head.classification_head.module_list.0.0.1.running_mean"


def _picture() -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Draw blocks of colour, 200 x 120, in BGR order."""
    coarse = np.random.default_rng(2).integers(0, 256, (12, 20, 3), np.uint8)
    return np.asarray(np.kron(coarse, np.ones((10, 10, 1))), np.uint8)


def _card(folder: Path, state: Mapping[str, Tensor], name: str = "my.pth", **more: Any) -> Path:
    path = folder / name
    if path.suffix == ".safetensors":
        save_file(dict(state), path)
    else:
        torch.save(dict(state), path)
    return crosscue.draft_card(path, class_names=NAMES, size_px=SIZE, **more).path


def _found(card: Path, score: float) -> Detections:
    pixels = _picture()
    size = (pixels.shape[1], pixels.shape[0])
    (found,) = build(card=str(card), score=score)([Frame(0, "/camera", pixels, size)])
    assert isinstance(found, Detections)
    return found


def _theirs(model: Any) -> dict[str, Any]:
    planes = torch.from_numpy(_picture()[:, :, ::-1].copy()).permute(2, 0, 1).contiguous()
    # The same number of threads, because the order of sums affects the last digits.
    with torch.inference_mode(), threads_of(1, torch.device("cpu")):
        (found,) = model([planes.float() / 255.0])
    # Boxes beyond the picture's edge have no area.
    is_seen = (found["boxes"][:, 2:] > found["boxes"][:, :2]).all(dim=1)
    return {key: value[is_seen].numpy() for key, value in found.items()}


FILES: tuple[tuple[ArchitectureName, str], ...] = (
    ("maskrcnn_resnet50_fpn", "my.pth"),
    ("fasterrcnn_mobilenet_v3_large_fpn", "my.safetensors"),
    ("retinanet_resnet50_fpn_v2", "my.pt"),
)


@pytest.mark.slow
@pytest.mark.parametrize(("architecture", "file"), FILES)
def test_boxes_and_masks_match_torchvision(
    tmp_path: Path, architecture: ArchitectureName, file: str
) -> None:
    first = ARCHITECTURES[architecture].first_class
    model = network(architecture, 3 + first, min_size=SIZE[1], max_size=SIZE[0])
    score = 0.05 if first else 0.005
    holder = getattr(model, "roi_heads", model)
    holder.score_thresh = score

    found = _found(_card(tmp_path, model.state_dict(), file, kind=architecture), score)
    theirs = _theirs(model)

    assert len(found) == len(theirs["boxes"]) > 0
    np.testing.assert_array_equal(found.boxes_px, theirs["boxes"].astype(np.float64))
    np.testing.assert_array_equal(found.scores, theirs["scores"].astype(np.float64))
    assert list(found.labels) == [NAMES[i - first] for i in theirs["labels"]]
    for text, mask, box in zip(found.masks, theirs.get("masks", []), theirs["boxes"], strict=False):
        expected = mask[0] > 0.5
        # Torchvision's masks extend a pixel beyond their box, crosscue's do not.
        x0, y0 = np.floor(box[:2]).astype(int)
        x1, y1 = np.ceil(box[2:]).astype(int)
        ours = rle.decode_mask(text, (200, 120)) if text else np.zeros_like(expected)
        np.testing.assert_array_equal(ours[y0:y1, x0:x1], expected[y0:y1, x0:x1])
    assert any(found.masks) == ("masks" in theirs)


@pytest.mark.slow
def test_frozen_batch_norm_weights_use_a_zero_epsilon(tmp_path: Path) -> None:
    """Detections match torchvision for its COCO weights and for fine-tuned ones."""
    from torchvision.ops import misc

    model = network("fasterrcnn_resnet50_fpn", min_size=SIZE[1], max_size=SIZE[0])
    body = model.backbone.body
    for name, module in list(body.named_modules()):
        if isinstance(module, torch.nn.BatchNorm2d):
            frozen = misc.FrozenBatchNorm2d(module.num_features, eps=0.0)
            frozen.load_state_dict(module.state_dict())
            # Variances so small that an epsilon of 1e-5 has an effect.
            frozen.running_var.fill_(1e-4)
            frozen.weight.fill_(1e-2)
            parent, _, last = name.rpartition(".")
            setattr(body.get_submodule(parent), last, frozen)

    card = _card(tmp_path, model.state_dict())

    settings = read_card(card).network
    assert settings is not None
    assert settings.norm_epsilon == 0.0
    found, theirs = _found(card, 0.05), _theirs(model)
    np.testing.assert_allclose(found.boxes_px, theirs["boxes"], atol=0.05)
    np.testing.assert_allclose(found.scores, theirs["scores"], atol=1e-4)


@pytest.mark.parametrize("architecture", get_args(ArchitectureName))
def test_each_architecture_is_recognised_by_its_tensors(
    tmp_path: Path, architecture: ArchitectureName
) -> None:
    from crosscue.detectors.catalog.recognise_weights import recognise_weights

    path = tmp_path / "my.pth"
    torch.save(hollow(architecture, 4), path)
    is_ambiguous = "mobilenet_v3_large" in architecture and "ssd" not in architecture
    if is_ambiguous:
        with pytest.raises(crosscue.UsageError, match="same tensors; choose one with --kind"):
            recognise_weights(path, None)

    _, guess = recognise_weights(path, architecture if is_ambiguous else None)

    assert guess.network is not None
    assert guess.network["architecture"] == architecture
    assert guess.class_count == 4 - ARCHITECTURES[architecture].first_class
    size = (guess.input or {})["width_px"], (guess.input or {})["height_px"]
    with torch.device("meta"):
        transform = network(architecture).transform
    wanted = transform.fixed_size or (transform.max_size, transform.min_size[0])
    assert size == wanted


def test_coco_class_names_are_known_and_others_are_required(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "my.pth"
    for classes, message in ((91, None), (4, "3 classes without names")):
        torch.save(hollow(SSDLITE, classes), path)
        state = run(["model", "init", str(path), "--overwrite"])
        error = capsys.readouterr().err
        if message is None:
            assert state == 0
            card = read_card(tmp_path / "my.toml")
            assert card.output.classes[2] == "car"
        else:
            assert state == 2
            assert message in error
    names = class_names(tmp_path, ("__background__", *NAMES))
    args = ["model", "init", str(path), "--overwrite", "--class-names", str(names)]
    assert run(args) == 0
    assert read_card(tmp_path / "my.toml").output.classes == NAMES
    assert run(["check", str(tmp_path / "my.toml")]) == 0


class _Malicious:
    """Object that creates a folder when it is unpickled."""

    def __init__(self, place: Path) -> None:
        self.place = place

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.place),)


def _with_code(folder: Path) -> object:
    return {"model": _Malicious(folder / "made_by_a_pickle")}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (_with_code, "holds code or objects other than tensors (posix.mkdir)"),
        (lambda folder: argparse.Namespace(epoch=1), "other than tensors (argparse.Namespace)"),
        (lambda folder: network(SSDLITE), "other than tensors (torchvision.models.detection"),
        (lambda folder: {"epoch": 3}, "'epoch' is int, not a tensor"),
        (lambda folder: [torch.zeros(2)], "list; expected a state dict"),
        (lambda folder: {}, "dict; expected a state dict"),
        (lambda folder: {"a": torch.zeros(2)}, "no tensors of a known network"),
        (
            lambda folder: {k: v for k, v in hollow(SSDLITE, 4).items() if k != MEAN},
            f"nearest is ssdlite320_mobilenet_v3_large, from which 1 differ: {MEAN} is missing",
        ),
        (
            lambda folder: hollow(SSDLITE, 4) | {MEAN: torch.zeros(3)},
            f"{MEAN} has shape (3,), expected (672,)",
        ),
    ],
)
def test_unsupported_weights_are_refused_on_one_line(
    tmp_path: Path, content: Any, message: str
) -> None:
    path = tmp_path / "my.pth"
    torch.save(content(tmp_path), path)

    assert message in refusal((1, 2), "model", "init", path)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["my.pth"]


def _oversized_archive() -> bytes:
    """Build an archive of zeros that declares an unpacked size above the limit."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", b"\0" * 1000)
    packed = bytearray(content.getvalue())
    at = packed.rindex(b"PK\1\2") + 24
    packed[at : at + 4] = (3 << 30).to_bytes(4, "little")
    return bytes(packed)


def _torchscript() -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name in ("data.pkl", "constants.pkl", "version"):
            archive.writestr(f"my/{name}", b"\x80\x02N.")
    return content.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("my.pt", _torchscript(), "TorchScript archive carries code"),
        ("my.pth", b"", "not a complete weights file"),
        ("my.pth", b"half of it", "not a complete weights file"),
        ("my.pth", _oversized_archive(), "unpacks to 3,221,225,472 bytes"),
        ("my.safetensors", b"half of it", "not a safetensors file"),
    ],
)
def test_damaged_weights_are_refused_on_one_line(
    tmp_path: Path, name: str, content: bytes, message: str
) -> None:
    (tmp_path / name).write_bytes(content)

    assert message in refusal((1, 2), "model", "init", tmp_path / name)


@pytest.fixture(scope="module")
def hollow_card(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The card of weights that are all zero."""
    path = tmp_path_factory.mktemp("hollow") / "my.pth"
    torch.save(hollow(SSDLITE, 4), path)
    return crosscue.draft_card(path, class_names=NAMES).path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"car", ', "", "its head has 3 classes and the background, the card lists 2"),
        (
            f'architecture = "{SSDLITE}"',
            'architecture = "fasterrcnn_resnet50_fpn"',
            "tensors do not fit fasterrcnn_resnet50_fpn",
        ),
        (
            f'architecture = "{SSDLITE}"',
            'architecture = "ssd301"',
            SSDLITE,
        ),
        ("width_px = 320", "width_px = 321", "accepts pictures of 320 x 320"),
        ('fit = "network"', 'fit = "stretch"', 'input.fit = "network" is required with [network]'),
        ('colour = "rgb"', 'colour = "bgr"', 'need colour = "rgb"'),
    ],
)
def test_card_that_contradicts_its_weights_is_refused(
    tmp_path: Path, hollow_card: Path, old: str, new: str, message: str
) -> None:
    shutil.copy(hollow_card.with_suffix(".pth"), tmp_path)
    card = tmp_path / hollow_card.name
    text = hollow_card.read_text(encoding="utf-8")
    assert old in text
    card.write_text(text.replace(old, new), encoding="utf-8")

    with pytest.raises(crosscue.errors.VehicleError) as error:
        build(card=str(card))

    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_nested_and_prefixed_weights_are_recognised(tmp_path: Path) -> None:
    from crosscue.detectors.catalog.recognise_weights import recognise_weights

    state = {f"module.{name}": value for name, value in hollow(SSDLITE, 4).items()}
    torch.save({"model": state, "epoch": 7}, tmp_path / "my.pth")

    _, guess = recognise_weights(tmp_path / "my.pth", None)

    assert guess.reasons[:2] == (
        "its weights are stored under 'model'",
        "its tensor names begin with 'module.'",
    )


def test_weights_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    torch.save(hollow(SSDLITE, 4) | {MEAN: torch.full((672,), torch.nan)}, tmp_path / "my.pth")

    wanted = f"{MEAN}: holds values that are not finite"
    with pytest.raises(crosscue.errors.VehicleError, match=wanted):
        crosscue.draft_card(tmp_path / "my.pth", class_names=NAMES)

    assert [one.name for one in tmp_path.iterdir()] == ["my.pth"]
