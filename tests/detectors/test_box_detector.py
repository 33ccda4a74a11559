"""Tests of the base class of box detectors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from crosscue.detectors.base import Choice, Detections, Frame, View
from crosscue.detectors.box_detector import BoxDetector, ScoredBox
from crosscue.detectors.registry import make
from crosscue.replay.errors import VehicleError
from crosscue.testing import check_detector


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


def test_boxes_are_in_camera_pixels() -> None:
    half = Frame(7, "cam", np.ones((30, 50), np.uint8), (100, 60))
    black = Frame(8, "cam", np.zeros((30, 50), np.uint8), (100, 60))

    first, second = Corner.build(side_px=10)([half, black])

    assert first.boxes_px.tolist() == [[0.0, 0.0, 20.0, 20.0]]
    assert (first.t_ns, first.labels, first.scores.tolist()) == (7, ("corner",), [0.5])
    assert (second.t_ns, len(second)) == (8, 0)


def test_settings_are_checked_and_decide_the_identity() -> None:
    with pytest.raises(VehicleError, match="detector corner: side: no such setting"):
        Corner.build(side=4)

    changed = type("Corner", (Corner,), {"version": 2, "__module__": __name__})

    assert Corner.build().identity == Corner.build(side_px=4).identity
    assert len({one.identity for one in (Corner(), Corner(side_px=5), changed())}) == 3


def test_detector_is_selected_by_class_and_factory() -> None:
    found = make(Choice("mine", f"{__name__}:Corner.build", {"side_px": 3}))

    assert isinstance(found, Corner)
    assert found.side_px == 3


class NoDetector:
    """Class with one of a detector's three members."""

    def __call__(self, frames: object) -> object:
        """Return nothing of use."""


def test_missing_detector_members_are_named() -> None:
    place = f"{__name__}:NoDetector"

    with pytest.raises(VehicleError, match=f"{place}.* without view, identity; .*BoxDetector"):
        make(Choice("mine", place, {}))


def test_detections_are_selected_by_label() -> None:
    boxes = np.array([[0, 0, 2, 5], [0, 0, 2, 7], [1, 1, 2, 2]], np.float64)
    found = Detections(0, (9, 9), boxes, np.ones(3), ("a", "b", "a"), (b"",) * 3)

    assert found.of("a").heights_px.tolist() == [5.0, 1.0]
    assert len(found.of("c")) == 0
