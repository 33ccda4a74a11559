"""torchvision's detection models exported to ONNX: boxes, labels, scores, perhaps masks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from .base import (
    Array,
    BoxOutput,
    Candidates,
    Guess,
    Interface,
    Outputs,
    Size,
    Tensor,
    class_numbers,
    named,
)


class TorchvisionOutput(BoxOutput):
    """Boxes (N, 4) in input pixels, labels (N,), scores (N,), masks (N, 1, H, W)."""

    kind: Literal["torchvision"]
    boxes: str = "boxes"
    labels: str = "labels"
    scores: str = "scores"
    masks: str | None = None
    """The output with masks over the whole input, where there is one."""
    first_class: int = 1
    """Number of the first listed class; torchvision's 0 is the background."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> Candidates:
        boxes = np.asarray(named(outputs, self.boxes, "boxes"), np.float64)
        scores = np.asarray(named(outputs, self.scores, "scores"), np.float64)
        labels = named(outputs, self.labels, "labels")
        if boxes.ndim == 3 and len(boxes) == 1:
            boxes, scores, labels = boxes[0], scores[0], labels[0]
        n = len(boxes)
        if boxes.shape != (n, 4) or scores.shape != (n,) or labels.shape != (n,):
            raise ValueError(
                f"expected boxes (N, 4), labels (N,), scores (N,), got {boxes.shape}, "
                f"{labels.shape}, {scores.shape}"
            )
        numbers = class_numbers(
            np.asarray(labels, np.float64) - self.first_class, len(self.classes)
        )
        if self.masks is None:
            return Candidates(boxes, scores, numbers)
        masks = named(outputs, self.masks, "masks")
        if masks.ndim != 4 or masks.shape[:2] != (n, 1):
            raise ValueError(f"masks: expected ({n}, 1, H, W), got {masks.shape}")
        return Candidates(boxes, scores, numbers, _WholeMasks(masks))

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        boxes, labels, scores, masks = (_one(model, name) for name in _NAMES)
        if boxes is None or labels is None or scores is None:
            return None
        settings: dict[str, object] = {"kind": "torchvision", "overlap": 1.0}
        if masks is not None:
            settings["masks"] = masks.name
        is_single = len(model.inputs[0].shape) == 3
        return Guess(
            settings,
            len(model.class_names) or None,
            ("its outputs are called boxes, labels and scores",),
            ("class 0 is the background, the classes start at 1",),
            {
                "colour": "rgb",
                "fit": "stretch",
                "scale": (1 / 255,) * 3,
                "layout": "chw" if is_single else "nchw",
            },
        )


_NAMES: Final = ("boxes", "labels", "scores", "masks")


def _one(model: Interface, name: str) -> Tensor | None:
    return next((out for out in model.outputs if out.name == name), None)


@dataclass(frozen=True, slots=True, eq=False)
class _WholeMasks:
    """Masks that come over the whole input, shape (N, 1, H, W)."""

    masks: Array

    def __call__(self, kept: NDArray[np.int64], /) -> NDArray[np.float64]:
        """Shape (len(kept), H, W)."""
        return np.asarray(self.masks[kept, 0], np.float64)
