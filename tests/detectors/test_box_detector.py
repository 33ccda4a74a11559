"""Tests of the base class of box detectors."""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
import pytest

import crosscue
from crosscue.detectors.base import Frame, View
from crosscue.detectors.box_detector import BoxDetector, ScoredBox
from crosscue.detectors.registry import chosen, make
from crosscue.replay.errors import UsageError, VehicleError
from crosscue.testing import check_detector
from support.pictures import picture_folder


class Corner(BoxDetector):
    """Detector of a square of a given side in the top left corner of the decoded picture."""

    name, labels, view = "corner", ("corner", "nothing"), View(min_width_px=50)
    side_px: int = 4

    def boxes_in(self, frame: Frame) -> Iterator[ScoredBox]:
        """Return one box in a frame that is not black."""
        if frame.pixels.any():
            yield "corner", 0.5, (0, 0, self.side_px, self.side_px)


def test_box_detector_meets_the_detector_contract() -> None:
    check_detector(Corner.build)


def test_settings_are_checked_and_decide_the_identity() -> None:
    with pytest.raises(VehicleError, match="detector corner: side: no such key"):
        Corner.build(side=4)

    changed = type("Corner", (Corner,), {"version": 2, "__module__": __name__})

    assert Corner.build().identity == Corner.build(side_px=4).identity
    assert len({one.identity for one in (Corner(), Corner(side_px=5), changed())}) == 3


def bright(frame: Frame) -> Iterator[ScoredBox]:
    """Return one box around the whole of a frame that is not black."""
    height, width = frame.pixels.shape[:2]
    if frame.pixels.any():
        yield "bright", 0.75, (0, 0, width, height)


@pytest.mark.parametrize(
    "given",
    [
        *(Corner, Corner(side_px=4), bright),
        *(f"{__name__}:{name}" for name in ("bright", "corner", "Corner", "Corner.build")),
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
        chosen([Corner, Corner], {})


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


corner = Corner(side_px=4)


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
