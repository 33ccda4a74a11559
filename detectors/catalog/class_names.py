"""Class names: COCO's, those that a user gives, and the labels of cues for other vocabularies."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from crosscue.replay.errors import UsageError
from crosscue.replay.files.bounded import read_text
from crosscue.replay.files.tree_text import yaml_tree
from crosscue.replay.limits import MIB

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

# Labels whose weak detections are kept, because tracks over frames decide on them.
CONTROL_LABELS: Final = ("stop sign", "traffic light")
# Labels that the default cues count.
CUE_LABELS: Final = (
    *CONTROL_LABELS,
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


def class_names_given(given: Sequence[str] | Path | str) -> tuple[str, ...]:
    """Return class names, or read them from a file: one per line, or ``names`` of a .yaml file.

    Raises:
        UsageError: The file cannot be read, or is empty.
    """
    if not isinstance(given, Path | str):
        return tuple(given)
    path = Path(given)
    text = read_text(path, MIB, UsageError, "expected class names, one per line")
    if path.suffix in (".yaml", ".yml"):
        return _yaml_names(path, text)
    names = tuple(line.strip() for line in text.splitlines() if line.strip())
    if not names:
        raise UsageError(f"{path}: contains no names; expected class names, one per line")
    return names


def _yaml_names(path: Path, text: str) -> tuple[str, ...]:
    try:
        names = yaml_tree(text)["names"]
        return tuple(str(names[i]) for i in range(len(names)))
    except (ValueError, KeyError, TypeError):
        raise UsageError(f"{path}: expected class names under names") from None
