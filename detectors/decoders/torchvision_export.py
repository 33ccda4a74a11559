"""Decoder of torchvision's detection models exported to ONNX."""

from typing import Final, Literal

import numpy as np
from typing_extensions import override

from .base import (
    PICTURE_SIZE_INPUT,
    BoxCandidates,
    BoxOutput,
    Guess,
    Interface,
    Outputs,
    Size,
    Tensor,
    class_numbers,
    named,
    static,
)

# Size to which torchvision's networks scale a picture, so that none is scaled twice.
_USUAL_SIZE_PX: Final = (1333, 800)


class TorchvisionOutput(BoxOutput):
    """Boxes (N, 4) in input pixels, labels (N,), scores (N,), masks (N, 1, H, W)."""

    kind: Literal["torchvision"]
    boxes: str = "boxes"
    labels: str = "labels"
    scores: str = "scores"
    masks: str | None = None
    """Name of the output with masks over the whole input, if it exists."""
    first_class: int = 1
    """Number of the first listed class; torchvision's 0 is the background."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
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
            return BoxCandidates(boxes, scores, numbers)
        masks = named(outputs, self.masks, "masks")
        if masks.ndim != 4 or masks.shape[:2] != (n, 1):
            raise ValueError(f"masks: expected ({n}, 1, H, W), got {masks.shape}")
        # Masks over the whole input.
        return BoxCandidates(
            boxes, scores, numbers, lambda kept: np.asarray(masks[kept, 0], np.float64)
        )

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        named_outputs = _by_name(model)
        found = named_outputs or _by_shape(model)
        if found is None:
            return None
        settings: dict[str, object] = {
            "kind": "torchvision",
            "overlap": 1.0,
            **{key: out.name for key, out in found.items() if key == "masks" or out.name != key},
        }
        if any(given.name == PICTURE_SIZE_INPUT for given in model.inputs[1:]):
            return Guess(
                {**settings, "first_class": 0},
                len(model.class_names) or None,
                (f"outputs boxes, labels and scores, and an input {PICTURE_SIZE_INPUT}",),
                ("it is of the DETR family: classes start at 0, pixels are scaled to 0..1",),
                {"colour": "rgb", "fit": "stretch", "scale": (1 / 255,) * 3},
            )
        is_single = len(model.inputs[0].shape) == 3
        return Guess(
            settings,
            len(model.class_names) or None,
            (
                "its outputs are called boxes, labels and scores"
                if named_outputs
                else "outputs of N x 4, N integers and N scores: boxes, labels, scores",
            ),
            ("class 0 is the background, the classes start at 1",),
            {
                "colour": "rgb",
                "fit": "letterbox",
                "scale": (1 / 255,) * 3,
                "layout": "chw" if is_single else "nchw",
            },
            usual_size_px=_USUAL_SIZE_PX,
            numbers_as_coco=True,
            is_decided=named_outputs is not None,
        )


def _by_name(model: Interface) -> dict[str, Tensor] | None:
    """Outputs by the keys of torchvision's results, if the export has these names."""
    found = {out.name: out for out in model.outputs if out.name in ("boxes", "labels", "scores")}
    if len(found) < 3:
        return None
    return found | {out.name: out for out in model.outputs if out.name == "masks"}


def _by_shape(model: Interface) -> dict[str, Tensor] | None:
    """Outputs by the keys of torchvision's results, if their shapes determine them."""
    kinds = {
        "boxes": [o for o in model.outputs if len(o.shape) == 2 and static(o.shape, 1) == 4],
        "labels": [o for o in model.outputs if len(o.shape) == 1 and o.is_integer],
        "scores": [o for o in model.outputs if len(o.shape) == 1 and not o.is_integer],
        "masks": [o for o in model.outputs if len(o.shape) == 4],
    }
    found = {key: outputs[0] for key, outputs in kinds.items() if outputs}
    is_whole = len(found) == len(model.outputs) and {"boxes", "labels", "scores"} <= {*found}
    return found if is_whole else None
