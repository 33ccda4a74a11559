"""Every built-in detector fulfils the contract of ``crosscue.testing.check_detector``."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from crosscue.detectors.base import Detections, DetectorChoice, Found, Frame
from crosscue.detectors.registry import BUILTIN, make
from crosscue.testing import check_detector
from support.detecting import BrightBlob, BrightSettings, build, too_few, yolox_card

NEEDS_A_CARD: Final = {"model"}


@pytest.mark.parametrize("name", sorted(BUILTIN.keys() - NEEDS_A_CARD))
def test_every_detector_fulfils_contract(name: str) -> None:
    check_detector(lambda: make(DetectorChoice(name, name)))


def test_detector_of_model_card_fulfils_contract(tmp_path: Path) -> None:
    card = str(yolox_card(tmp_path))

    check_detector(lambda: make(DetectorChoice("yolox", "model", {"card": card})))


class _WrongTime(BrightBlob):
    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        return [replace(self._one(frame), t_ns=frame.t_ns + 1) for frame in frames]


class _BoxOutsidePicture(BrightBlob):
    def _one(self, frame: Frame) -> Detections:
        found = super()._one(frame)
        return replace(found, boxes_px=found.boxes_px + 1.0)


class _ScoreAboveOne(BrightBlob):
    def _one(self, frame: Frame) -> Detections:
        found = super()._one(frame)
        return replace(found, scores=found.scores * 1.01)


class _ChangesPixels(BrightBlob):
    def _one(self, frame: Frame) -> Detections:
        found = super()._one(frame)
        np.asarray(frame.pixels)[0] = 0
        return found


class _UndeclaredLabel(BrightBlob):
    labels = ("zebra",)


class _RepeatsFirstFrame(BrightBlob):
    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        return [self._one(frames[0]) for _ in frames]


@pytest.mark.parametrize(
    ("kind", "match"),
    [
        (_WrongTime, "time and size of the result"),
        (_BoxOutsidePicture, "not inside the picture"),
        (_ScoreAboveOne, "expected 0 to 1"),
        (_ChangesPixels, "changed a frame's pixels"),
        (_UndeclaredLabel, "label not declared; expected one of zebra"),
        (_RepeatsFirstFrame, "frame 17: time and size"),
    ],
)
def test_contract_check_reports_invalid_detector(kind: type[BrightBlob], match: str) -> None:
    with pytest.raises(AssertionError, match=match):
        check_detector(lambda: kind(BrightSettings()))


def test_contract_check_reports_missing_results() -> None:
    check_detector(build)
    with pytest.raises(AssertionError, match="3 frames, 0 results"):
        check_detector(too_few)
