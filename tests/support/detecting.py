"""A simple detector, invalid variants of it, and a card for the real YOLOX-nano."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crosscue.detectors.base import Detections, Found, Frame, View
from crosscue.detectors.box_detector import BoxDetector, ScoredBox
from crosscue.detectors.catalog.class_names import COCO_80
from crosscue.detectors.settings import Settings, identity_of, settings_of

from .data import shared


class BrightSettings(Settings):
    """Settings of ``BrightBlob``."""

    threshold: int = 200


@dataclass(frozen=True, slots=True)
class BrightBlob:
    """A detector that returns one box around all bright pixels."""

    settings: BrightSettings
    view = View(is_grey=True)

    @property
    def identity(self) -> str:
        """Identity of the settings."""
        return identity_of("bright", self.settings.model_dump())

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Detect."""
        return [self._one(frame) for frame in frames]

    def _one(self, frame: Frame) -> Detections:
        rows, columns = np.nonzero(frame.pixels > self.settings.threshold)
        if not len(rows):
            return Detections(frame.t_ns, frame.size_px, np.empty((0, 4)), np.empty(0), (), ())
        box = [[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]]
        boxes = np.array(box, np.float64)
        return Detections(frame.t_ns, frame.size_px, boxes, np.ones(1), ("bright",), (b"",))


class Nothing(BoxDetector):
    """A detector that finds nothing."""

    name, labels, view = "nothing", ("car",), View(is_grey=True)

    def boxes_in(self, frame: Frame) -> Iterator[ScoredBox]:
        """Yield no box."""
        yield from ()


def build(**settings: object) -> BrightBlob:
    """Build the detector, as a user's factory does."""
    return BrightBlob(settings_of(BrightSettings, settings, "detector bright"))


def too_few(**settings: object) -> BrightBlob:
    """Build a detector that returns no results, which violates the contract."""

    class Forgetful(BrightBlob):
        def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
            return []

    return Forgetful(BrightSettings())


def yolox_card(folder: Path, **changes: str) -> Path:
    """Write a card for the real YOLOX-nano, with the given values changed."""
    weights = shared("weights", "yolox_nano", "yolox_nano.onnx")
    values = {
        "weights": f'"{weights}"',
        "sha256": '"c789161ed43c8269fcd4e67c67eeeb4e80c622da2eb296a20bc6007bd18a0b7d"',
        "width_px": "416",
        "classes": "[" + ", ".join(f'"{name}"' for name in COCO_80) + "]",
    } | changes
    text = (
        f"version = 1\nweights = {values['weights']}\nsha256 = {values['sha256']}\n"
        f'[input]\nwidth_px = {values["width_px"]}\nheight_px = 416\nfit = "letterbox"\n'
        f'[output]\nkind = "yolox"\nclasses = {values["classes"]}\n'
    )
    path = folder / "yolox.toml"
    path.write_text(text, encoding="utf-8")
    return path
