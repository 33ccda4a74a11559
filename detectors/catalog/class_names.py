"""COCO's class names, and the labels of crosscue's cues for names of other vocabularies."""

from __future__ import annotations

import re
from typing import Final

COCO_80: Final = (
    "person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat",
    "traffic light", "fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat", "dog",
    "horse", "sheep", "cow", "elephant", "bear", "zebra", "giraffe", "backpack", "umbrella",
    "handbag", "tie", "suitcase", "frisbee", "skis", "snowboard", "sports ball", "kite",
    "baseball bat", "baseball glove", "skateboard", "surfboard", "tennis racket", "bottle",
    "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple", "sandwich", "orange",
    "broccoli", "carrot", "hot dog", "pizza", "donut", "cake", "chair", "couch", "potted plant",
    "bed", "dining table", "toilet", "tv", "laptop", "mouse", "remote", "keyboard", "cell phone",
    "microwave", "oven", "toaster", "sink", "refrigerator", "book", "clock", "vase", "scissors",
    "teddy bear", "hair drier", "toothbrush",
)  # fmt: skip
# Numbers below 91 that COCO's numbering of its 80 classes skips.
_GAPS: Final = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)


def _coco_90() -> tuple[str, ...]:
    names = iter(COCO_80)
    return tuple(f"unused {n}" if n in _GAPS else next(names) for n in range(1, 91))


# Class names by COCO's own numbers, which have gaps: number n is at index n - 1.
COCO_90: Final = _coco_90()

# Labels that the default cues count.
CUE_LABELS: Final = (
    "stop sign",
    "traffic light",
    "car",
    "truck",
    "bus",
    "one way left",
    "one way right",
    "do not enter",
)

_MEANINGS: Final = {
    "stop": "stop sign",
    "stopsign": "stop sign",
    "trafficsignal": "traffic light",
    "signal": "traffic light",
    "light": "traffic light",
    "trafficlight": "traffic light",
    "vehicle": "car",
    "auto": "car",
    "sedan": "car",
    "suv": "car",
    "lorry": "truck",
    "onewayleft": "one way left",
    "onewayright": "one way right",
    "noentry": "do not enter",
    "donotenter": "do not enter",
}


def cue_label(name: str) -> str | None:
    """Return the cue label for a class name of another vocabulary; None if unknown."""
    bare = re.sub(r"[^a-z]", "", name.lower())
    by_spelling = {re.sub(r"[^a-z]", "", label): label for label in CUE_LABELS}
    return by_spelling.get(bare) or _MEANINGS.get(bare)
