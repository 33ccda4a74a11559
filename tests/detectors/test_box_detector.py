"""Tests of the base class of box detectors."""

from collections.abc import Iterator
from pathlib import Path

import pytest

import crosscue
from crosscue.detectors.base import Frame, View
from crosscue.detectors.box_detector import BoxDetector, ScoredBox
from crosscue.detectors.registry import chosen, make
from crosscue.replay.errors import CrosscueError, UsageError, VehicleError
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
    with pytest.raises(VehicleError, match="detector corner: side: no such setting"):
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
    "given", [Corner, Corner(side_px=4), bright, f"{__name__}:Corner", f"{__name__}:Corner.build"]
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


class Yields(BoxDetector):
    """Detector that yields what a test gives it."""

    name, labels = "yields", ("stop sign",)
    item: tuple[object, ...] = ()

    def boxes_in(self, frame: Frame) -> Iterator[ScoredBox]:
        """Return the item as it is."""
        yield self.item  # type: ignore[misc]


@pytest.mark.parametrize(
    ("item", "fault"),
    [
        (("stop sign", 0.9, (10, 20, 5, 5)), "'stop sign' at (10, 20, 5, 5): x1 < x0"),
        (("stop sign", 90, (10, 8, 15, 12)), "score 90; expected 0 to 1"),
        (("stop sign", 0.9, (10, 8, 15, 99)), "not inside the picture of (24, 16) px"),
        (("stop_sign", 0.9, (10, 8, 15, 12)), "label not declared; expected one of stop sign"),
        (("stop sign", (10, 8, 15, 12)), "expected (label, score, (x0, y0, x1, y1))"),
        (("stop sign", 0.9, (10, 8, 15)), "expected (label, score, (x0, y0, x1, y1))"),
    ],
)
def test_wrong_box_of_a_run_is_refused_with_frame_and_reason(
    item: tuple[object, ...], fault: str, tmp_path: Path
) -> None:
    log = picture_folder(tmp_path / "log", 2, "rate_hz: 10")

    with pytest.raises(CrosscueError) as refused:
        crosscue.detect_drive(log, tmp_path / "run", detectors=[Yields.build(item=item)])

    assert str(refused.value).startswith("detector yields: ")
    assert " ns: " in str(refused.value)
    assert fault in str(refused.value)


class Unnamed(BoxDetector):
    """Detector as a beginner writes it, without a name."""

    labels = ("stop sign",)

    def boxes_in(self, frame: Frame) -> Iterator[ScoredBox]:
        """Return nothing."""
        yield from ()


class Unlabelled(BoxDetector):
    """Detector without labels."""

    def boxes_in(self, frame: Frame) -> Iterator[ScoredBox]:
        """Return nothing."""
        yield from ()


def test_class_without_a_name_is_named_after_itself_and_one_without_labels_is_refused() -> None:
    check_detector(Unnamed.build)
    assert Unnamed.name == "Unnamed"
    with pytest.raises(VehicleError, match="detector Unlabelled: no labels; set labels ="):
        chosen([Unlabelled], {})
