"""Boxes: the base class of their detectors, suppression, choice, pooling and drawn labels."""

import copy
import re
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torchvision.ops import MultiScaleRoIAlign

import crosscue
from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Frame, View
from crosscue.detectors.box_detector import BoxDetector, ScoredBox
from crosscue.detectors.boxes import box_ious, non_maximum_suppression
from crosscue.detectors.label_images import CLASSES, LabelledObject, label_image, objects
from crosscue.detectors.networks.mask_rcnn.network import build_network
from crosscue.detectors.networks.mask_rcnn.parts import Pooler, likeliest_apart
from crosscue.detectors.registry import chosen, make
from crosscue.replay.errors import UsageError, VehicleError
from crosscue.testing import check_detector
from support.mask_rcnn import plan_of
from support.pictures import picture_folder


def test_suppression_keeps_the_best_of_overlapping_boxes() -> None:
    rng = np.random.default_rng(5)
    corners = rng.uniform(0.0, 60.0, (700, 2))
    boxes = np.hstack([corners, corners + rng.uniform(5.0, 30.0, (700, 2))])
    scores, groups = rng.uniform(0.0, 1.0, 700), rng.integers(0, 3, 700)

    expected: list[int] = []
    for i in np.argsort(-scores):
        rivals = [k for k in expected if groups[k] == groups[i]]
        if scores[i] >= 0.2 and not (box_ious(boxes[i], boxes[rivals]) > 0.45).any():
            expected.append(int(i))

    assert non_maximum_suppression(boxes, scores, groups, 0.2, 0.45).tolist() == expected
    assert not len(non_maximum_suppression(boxes, scores, groups, 2.0, 0.45))


SIZE_PX = (96, 128)
RPN = build_network(plan_of()).eval().rpn


@given(
    st.lists(st.integers(0, 500), min_size=1, max_size=4),
    st.integers(1, 1000),
    st.sampled_from([0.0, 0.3, 0.9]),
    st.integers(0, 1000),
    st.floats(5.0, 60.0),
)
def test_selected_boxes_and_their_order_match_torchvision(
    counts: list[int], max_count: int, floor: float, seed: int, spread_px: float
) -> None:
    rng = np.random.default_rng(seed)
    total = sum(counts)
    middles = rng.uniform(-20.0, 150.0, (total, 2))
    halves = rng.exponential(spread_px / 2.0, (total, 2)) * (rng.random((total, 1)) > 0.1)
    boxes = torch.from_numpy(np.hstack([middles - halves, middles + halves]).astype(np.float32))
    logits = torch.from_numpy(rng.normal(0.0, 2.0, total).astype(np.float32))
    rpn = copy.deepcopy(RPN)
    rpn._pre_nms_top_n["testing"], rpn._post_nms_top_n["testing"] = 1000, max_count
    rpn.score_thresh = floor

    ours = likeliest_apart(rpn, boxes, logits, np.repeat(np.arange(len(counts)), counts), SIZE_PX)
    theirs, _ = rpn.filter_proposals(boxes[None], logits[None], [SIZE_PX], counts)

    assert torch.equal(ours, theirs[0])


HEIGHT_PX, WIDTH_PX = 128, 192


def _levels(strides: tuple[int, ...], pictures: int, channels: int = 3) -> list[Tensor]:
    torch.manual_seed(len(strides))
    return [torch.randn(pictures, channels, HEIGHT_PX // s, WIDTH_PX // s) for s in strides]


Side = st.floats(0.0, 400.0, width=32)
Corner = st.tuples(st.floats(-60.0, 250.0, width=32), st.floats(-60.0, 250.0, width=32))
Boxes = st.lists(st.tuples(Corner, Side, Side), max_size=6)


def _tensor(boxes: list[tuple[tuple[float, float], float, float]]) -> Tensor:
    corners = [(x, y, x + width, y + height) for (x, y), width, height in boxes]
    return torch.tensor(corners, dtype=torch.float32).reshape(-1, 4)


@given(st.sampled_from([(4, 8, 16, 32), (8, 16, 32)]), st.sampled_from([7, 14]), Boxes, Boxes)
def test_pooled_features_match_torchvision(
    strides: tuple[int, ...],
    side: int,
    first: list[tuple[tuple[float, float], float, float]],
    second: list[tuple[tuple[float, float], float, float]],
) -> None:
    levels = _levels(strides, pictures=2)
    names = [str(i) for i in range(len(strides))]
    pool = MultiScaleRoIAlign(names, side, 2)
    boxes = [_tensor(first), _tensor(second)]

    theirs = pool(OrderedDict(zip(names, levels, strict=True)), boxes, [(HEIGHT_PX, WIDTH_PX)] * 2)
    ours = Pooler(levels, HEIGHT_PX)(pool, boxes)

    assert ours.shape == (len(first) + len(second), 3, side, side)
    np.testing.assert_allclose(ours.numpy(), theirs.numpy(), atol=2e-6)


SIZE_PX_IMAGES = (40, 30)


def frame(image: np.ndarray) -> Frame:
    return Frame(7, "camera", np.ascontiguousarray(image[..., ::-1]), SIZE_PX_IMAGES)


def found(*drawn: LabelledObject) -> Detections:
    (one,) = objects()([frame(label_image(np.zeros((30, 40), np.bool_), drawn))])
    assert isinstance(one, Detections)
    return one


@pytest.mark.parametrize("label", CLASSES)
def test_drawn_object_is_recovered_with_box_mask_and_score(label: str) -> None:
    mask = np.array([[True, False], [True, True], [True, True]])

    back = found(LabelledObject(label, 0.8, (10, 5), mask))

    assert back.labels == (label,)
    assert back.scores[0] == pytest.approx(0.8, abs=1 / 255)
    np.testing.assert_array_equal(back.boxes_px, [[10, 5, 12, 8]])
    np.testing.assert_array_equal(rle.decode_mask(back.masks[0], SIZE_PX_IMAGES)[5:8, 10:12], mask)


def test_black_image_has_no_objects() -> None:
    assert len(found()) == 0


class TopLeft(BoxDetector):
    """Detector of a square of a given side in the top left corner of the decoded picture."""

    name, labels, view = "corner", ("corner", "nothing"), View(min_width_px=50)
    side_px: int = 4

    def boxes_in(self, frame: Frame) -> Iterator[ScoredBox]:
        """Return one box in a frame that is not black."""
        if frame.pixels.any():
            yield "corner", 0.5, (0, 0, self.side_px, self.side_px)


def test_box_detector_meets_the_detector_contract() -> None:
    check_detector(TopLeft.build)


def test_settings_are_checked_and_decide_the_identity() -> None:
    with pytest.raises(VehicleError, match="detector corner: side: no such key"):
        TopLeft.build(side=4)

    changed = type("TopLeft", (TopLeft,), {"version": 2, "__module__": __name__})

    assert TopLeft.build().identity == TopLeft.build(side_px=4).identity
    assert len({one.identity for one in (TopLeft(), TopLeft(side_px=5), changed())}) == 3


def bright(frame: Frame) -> Iterator[ScoredBox]:
    """Return one box around the whole of a frame that is not black."""
    height, width = frame.pixels.shape[:2]
    if frame.pixels.any():
        yield "bright", 0.75, (0, 0, width, height)


@pytest.mark.parametrize(
    "given",
    [
        *(TopLeft, TopLeft(side_px=4), bright),
        *(f"{__name__}:{name}" for name in ("bright", "corner", "TopLeft", "TopLeft.build")),
    ],
)
def test_class_object_function_and_name_are_detectors(given: object) -> None:
    (choice,) = chosen([given], {})

    check_detector(lambda: make(choice))
    assert ":" in choice.kind


def test_same_function_has_the_same_identity_and_another_source_another() -> None:
    def other(frame: Frame) -> Iterator[ScoredBox]:
        return bright(frame)

    first, again, second = (make(chosen([one], {})[0]) for one in (bright, bright, other))

    assert first.identity == again.identity != second.identity


def test_other_objects_are_no_detectors() -> None:
    with pytest.raises(UsageError, match="detectors: 5: expected a name, a class, a function"):
        chosen([5], {})
    with pytest.raises(UsageError, match="corner, corner: one is named twice"):
        chosen([TopLeft, TopLeft], {})


class Returns(BoxDetector):
    """Detector that returns what a test gives it."""

    name, labels = "returns", ("stop sign",)
    found: Any = None

    def boxes_in(self, frame: Frame) -> Iterable[ScoredBox]:
        """Return it as it is, rows of numbers as an array."""
        is_array = self.found and isinstance(self.found[0], list)
        return np.array(self.found) if is_array else self.found


BOX = (10, 8, 15, 12)
ITEM = "expected (label, score, (x0, y0, x1, y1)) with finite numbers"
MISTAKES = {
    "width and height": ([("stop sign", 0.9, (10, 12, 5, 5))], "'stop sign' at (10, 12, 5, 5): x1"),
    "y before x": ([("stop sign", 0.9, (12, 3, 5, 9))], "x1 < x0 or y1 < y0; expected x0, y0"),
    "per cent": ([("stop sign", 90, BOX)], "score 90; expected 0 to 1"),
    "fractions": ([("stop sign", 0.9, (0.1, 0.2, 0.3, 0.4))], "expected pixels, not fractions"),
    "outside": ([("stop sign", 0.9, (10, 8, 15, 999))], "not inside the picture of"),
    "negative": ([("stop sign", 0.9, (-10, 8, 15, 12))], "not inside the picture of"),
    "undeclared": ([("stop_sign", 0.9, BOX)], "label not declared; expected one of stop sign"),
    "number": ([(11, 0.9, BOX)], f"box 0: yielded (11, 0.9, (10, 8, 15, 12)); {ITEM}"),
    "no score": ([("stop sign", BOX)], ITEM),
    "three corners": ([("stop sign", 0.9, (10, 8, 15))], ITEM),
    "flat": ([("stop sign", 0.9, *BOX)], ITEM),
    "score first": ([(0.9, "stop sign", BOX)], ITEM),
    "one box": (("stop sign", 0.9, BOX), "box 0: yielded 'stop sign'; expected"),
    "dictionaries": ([{"label": "stop sign", "score": 0.9, "box": BOX}], "yielded {'label'"),
    "rows": ([[10.0, 8.0, 15.0, 12.0, 0.9, 0.0]], "box 0: yielded array([10. "),
    "no number": (
        [("stop sign", float("nan"), BOX)],
        f"box 0: yielded ('stop sign', nan, (10, 8, 15, 12)); {ITEM}",
    ),
    "no corner": (
        [("stop sign", 0.9, BOX), ("stop sign", 0.9, (10, float("nan"), 15, 12))],
        "box 1: yielded",
    ),
    "nothing": (None, "returned None; expected (label"),
    "a number": (0, "returned 0; expected (label"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake_is_refused_in_run_and_test_with_frame_and_reason(
    mistake: str, tmp_path: Path
) -> None:
    log = picture_folder(tmp_path / "log", 2, "rate_hz: 10")
    found, fault = MISTAKES[mistake]
    detector = Returns.build(found=found)

    with pytest.raises(UsageError) as refused:
        crosscue.detect_drive(log, tmp_path / "run", detectors=[detector])
    with pytest.raises(AssertionError) as broken:
        check_detector(lambda: detector)

    message = str(refused.value)
    assert re.match(r"detector returns: frame at \d+ ns: ", message)
    assert fault in message
    assert "\n" not in message
    assert re.match(r"frame (at )?7( ns)?: ", str(broken.value))
    assert fault.replace("24, 16", "160, 96") in str(broken.value)


class Failing(BoxDetector):
    """Detector with a mistake in its code."""

    labels = ("stop sign",)

    def boxes_in(self, frame: Frame) -> Iterator[ScoredBox]:
        """Read a pixel that does not exist."""
        yield "stop sign", frame.pixels[5000, 5000], BOX


class Bare:
    """Class with the method of a detector only."""

    def __call__(self, frames: object) -> list[object]:
        """Return nothing."""
        return []


class Abstract(BoxDetector):
    """Detector without ``boxes_in``."""

    labels = ("stop sign",)


@pytest.mark.parametrize(
    ("kind", "fault"),
    [
        (Failing, "it failed: IndexError: index 5000"),
        (Bare, "no view, identity; derive from crosscue.BoxDetector"),
        (Abstract, "it failed: TypeError: Can't instantiate abstract class Abstract"),
    ],
)
def test_other_mistakes_break_the_contract_in_one_line(kind: Any, fault: str) -> None:
    with pytest.raises(AssertionError, match=re.escape(fault)) as broken:
        check_detector(kind)

    assert "\n" not in str(broken.value)


corner = TopLeft(side_px=4)


class Unlabelled(BoxDetector):
    """Detector without labels."""

    def boxes_in(self, frame: Frame) -> Iterator[ScoredBox]:
        """Return nothing."""
        yield from ()


class Unnamed(Unlabelled):
    """Detector as a beginner writes it, without a name."""

    labels = ("stop sign",)


class OneText(Unlabelled):
    """Detector whose labels are a text."""

    labels = "stop sign"  # type: ignore[assignment]


def test_class_without_a_name_is_named_after_itself_and_one_without_labels_is_refused() -> None:
    check_detector(Unnamed.build)
    assert Unnamed.name == "Unnamed"
    with pytest.raises(VehicleError, match="detector Unlabelled: no labels; set labels ="):
        chosen([Unlabelled], {})
    with pytest.raises(VehicleError, match="detector OneText: labels is 'stop sign'; set labels ="):
        chosen([OneText], {})
    with pytest.raises(AssertionError, match="detector Unlabelled: no labels"):
        check_detector(Unlabelled)


def test_function_without_a_source_is_refused_with_what_to_do() -> None:
    """A function typed at the prompt of Python has no source, and so no identity."""
    text = 'def red(frame):\n    yield "stop sign", 0.9, (1, 2, 3, 4)'
    function = FunctionType(compile(text, "<stdin>", "exec").co_consts[0], {}, "red")

    with pytest.raises(UsageError, match="red: its source cannot be read; define it in a module"):
        make(chosen([function], {})[0])
