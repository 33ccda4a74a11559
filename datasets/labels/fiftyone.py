"""Read and write FiftyOne's ``FiftyOneImageDetectionDataset``: ``labels.json`` and ``data``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from crosscue.datasets.truth.annotations import (
    Annotation,
    Annotations,
    Picture,
    Sizes,
    labelled_size,
)
from crosscue.replay.errors import AnnotationError
from crosscue.replay.files.tree_text import json_tree, strict_json
from crosscue.replay.files.whole_file import write_text

FILE = "labels.json"


def write_fiftyone(folder: Path, labels: Annotations) -> Path:
    """Write labels: boxes as x, y, width and height in fractions of the picture.

    Raises:
        OutputError: The file cannot be written.
    """
    found = {}
    for picture in labels.pictures:
        wide, high = picture.size_px
        things = []
        for thing in picture.things:
            if thing.box_px is None:
                continue
            x0, y0, x1, y1 = thing.box_px
            box = [x0 / wide, y0 / high, (x1 - x0) / wide, (y1 - y0) / high]
            one: dict[str, Any] = {
                "label": labels.labels.index(thing.label),
                "bounding_box": box,
            }
            things.append(one if thing.score is None else one | {"confidence": thing.score})
        found[Path(picture.name).stem] = things
    tree = {"classes": list(labels.labels), "labels": found}
    write_text(folder / FILE, strict_json(tree) + "\n")
    return folder / FILE


def read_fiftyone(path: Path, sizes: Sizes) -> Annotations:
    """Read ``labels.json``, or the folder that contains it.

    Raises:
        AnnotationError: The file cannot be read, or the size of a picture is unknown.
    """
    file = path / FILE if path.is_dir() else path
    try:
        tree = json_tree(file.read_bytes())
    except (OSError, ValueError) as error:
        raise AnnotationError(f"{file}: not readable as JSON ({error})") from None
    by_picture = tree.get("labels") if isinstance(tree, dict) else None
    classes = (tree.get("classes") or []) if isinstance(tree, dict) else []
    if not isinstance(by_picture, dict) or not isinstance(classes, list):
        raise AnnotationError(f"{file}: expected classes and labels, as FiftyOne exports them")
    pictures = []
    for name, rows in by_picture.items():
        stem = Path(name).stem if name.lower().endswith((".jpg", ".png", ".jpeg")) else name
        stem = stem.rpartition("/")[2]
        size = labelled_size(stem, sizes, file)
        things = [_thing(row, classes, size, f"{file}: {name}") for row in rows or ()]
        pictures.append(Picture(stem, size, None, None, tuple(things)))
    used = {thing.label for one in pictures for thing in one.things}
    names = dict.fromkeys([*map(str, classes), *sorted(used)])
    return Annotations(str(file), tuple(names), tuple(pictures))


def _thing(row: Any, classes: list[Any], size: tuple[int, int], where: str) -> Annotation:
    try:
        label, (x, y, w, h) = row["label"], (float(side) for side in row["bounding_box"])
        # FiftyOne writes class numbers if there is a list of classes, else class names.
        name = str(classes[label]) if isinstance(label, int) else str(label)
        score = row.get("confidence")
        box = (x * size[0], y * size[1], (x + w) * size[0], (y + h) * size[1])
        return Annotation(name, box, score=None if score is None else float(score), place=where)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError):
        raise AnnotationError(
            f"{where}: expected label and bounding_box (x, y, width, height as fractions)"
        ) from None
