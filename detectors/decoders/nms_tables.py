"""Decoders of exports with suppression: YOLOv7's, mmdeploy's and TensorRT's EfficientNMS."""

from typing import Final, Literal

import numpy as np
from typing_extensions import override

from .base import (
    IMAGENET_BGR,
    BoxCandidates,
    BoxOutput,
    Guess,
    Interface,
    Outputs,
    Size,
    class_numbers,
    is_called,
    named,
    output_rows,
    static,
)
from .yolo import PICTURE

# Names of the outputs with YOLOv6 to v9 and DAMO-YOLO, and in TensorRT's documentation.
_NAMES: Final = (
    ("num_dets", "det_boxes", "det_scores", "det_classes"),
    ("num_detections", "detection_boxes", "detection_scores", "detection_classes"),
)


class YoloV7NmsOutput(BoxOutput):
    """One output (N, 7): number of the picture, x0, y0, x1, y1 in input pixels, class, score."""

    kind: Literal["yolov7-nms"]
    name: str | None = None
    """Name of the output; by default the only output."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        rows = named(outputs, self.name)
        if rows.ndim != 2 or rows.shape[1] != 7:
            raise ValueError(f"expected (N, 7), got {rows.shape}")
        table = np.asarray(rows, np.float64)
        return BoxCandidates(
            table[:, 1:5], table[:, 6], class_numbers(table[:, 5], len(self.classes))
        )

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        output = model.outputs[0]
        if len(model.outputs) != 1 or len(output.shape) != 2 or static(output.shape, 1) != 7:
            return None
        return Guess(
            {"kind": "yolov7-nms", "overlap": 1.0},
            len(model.class_names) or model.class_count,
            ("rows of 7, as YOLOv7 exports with --end2end --max-wh",),
            ("boxes are in input pixels",),
            PICTURE,
        )


class MmdeployOutput(BoxOutput):
    """Boxes (1, N, 5): x0, y0, x1, y1 in input pixels, score; class numbers (1, N).

    Open Model Zoo's exports have no axis of pictures.
    """

    kind: Literal["mmdeploy"]
    boxes: str = "dets"
    labels: str = "labels"

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        boxes, labels = named(outputs, self.boxes, "boxes"), named(outputs, self.labels, "labels")
        if boxes.ndim == 2:
            boxes, labels = boxes[None], labels[None]
        rows = output_rows(boxes, 5, "boxes and scores")
        if labels.shape != (1, len(rows)):
            raise ValueError(f"labels: expected (1, {len(rows)}), got {labels.shape}")
        # Rows after the detections are zeros, and their class may be -1.
        kept = ~(rows[:, 4] <= 0.0)
        numbers = class_numbers(np.asarray(labels[0], np.float64)[kept], len(self.classes))
        return BoxCandidates(rows[kept, :4], rows[kept, 4], numbers)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        by_name = {out.name: out for out in model.outputs}
        if is_called(model, "boxes", "labels") and static(by_name["boxes"].shape, 1) == 5:
            return Guess(
                {"kind": "mmdeploy", "boxes": "boxes", "overlap": 1.0},
                len(model.class_names) or model.class_count,
                ("outputs boxes, of 5 columns, and labels, as in Open Model Zoo",),
                ("pixels are BGR, from 0 to 255",),
                {"colour": "bgr", "fit": "stretch"},
                needs_names=True,
            )
        if not is_called(model, "dets", "labels") or static(by_name["dets"].shape, 2) != 5:
            return None
        return Guess(
            {"kind": "mmdeploy", "overlap": 1.0},
            len(model.class_names) or model.class_count,
            ("outputs dets, of 5 columns, and labels, as mmdeploy names them",),
            (
                "pixels are BGR with ImageNet's mean and deviation, as RTMDet expects; see "
                "to_rgb, mean and std in pipeline.json",
            ),
            {**IMAGENET_BGR, "fit": "letterbox"},
        )


class EfficientNmsOutput(BoxOutput):
    """Count (1, 1), boxes (1, N, 4) as corners in input pixels, scores (1, N), classes (1, N)."""

    kind: Literal["efficient-nms"]
    count: str = _NAMES[0][0]
    boxes: str = _NAMES[0][1]
    scores: str = _NAMES[0][2]
    labels: str = _NAMES[0][3]

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        boxes = output_rows(named(outputs, self.boxes, "boxes"), 4, "boxes")
        scores, labels = (named(outputs, name) for name in (self.scores, self.labels))
        count = named(outputs, self.count, "count")
        if count.size != 1 or not scores.shape == labels.shape == (1, len(boxes)):
            raise ValueError(
                f"expected a count, and (1, {len(boxes)}) for scores and classes, got "
                f"{count.shape}, {scores.shape}, {labels.shape}"
            )
        some = slice(int(count.reshape(-1)[0]))
        numbers = class_numbers(np.asarray(labels[0, some], np.float64), len(self.classes))
        return BoxCandidates(boxes[some], np.asarray(scores[0, some], np.float64), numbers)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        names = next((names for names in _NAMES if is_called(model, *names)), None)
        if names is None or not _has_integers(model, names[0], names[3]):
            return None
        keys = ("count", "boxes", "scores", "labels")
        return Guess(
            {"kind": "efficient-nms", **dict(zip(keys, names, strict=True)), "overlap": 1.0},
            len(model.class_names) or model.class_count,
            (f"its outputs are called {', '.join(names)}",),
            ("boxes are corners in input pixels",),
            PICTURE,
        )


def _has_integers(model: Interface, *names: str) -> bool:
    """Return whether these outputs are integers; TensorFlow's detection API has floats there."""
    return all(out.is_integer for out in model.outputs if out.name in names)
