"""Read and write the formats of labelling tools: COCO, CVAT, YOLO and FiftyOne.

YOLO is that of Ultralytics: ``data.yaml``, ``labels/NAME.txt``, ``images``. Subsets in separate
folders (``labels/train``), as exported by FiftyOne and CVAT, can also be read, and so can Darknet's
``obj_train_data``, CVAT's "YOLO 1.1".
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

from crosscue.datasets.truth.annotations import (
    Annotation,
    Annotations,
    Picture,
    Sizes,
    labelled_size,
)
from crosscue.datasets.truth.box_labels import read_box_labels
from crosscue.datasets.truth.coco import read_coco, write_coco
from crosscue.datasets.truth.label_xml import read_cvat, write_cvat
from crosscue.replay.errors import AnnotationError, UsageError
from crosscue.replay.files.tree_text import read_json, strict_json
from crosscue.replay.files.whole_file import write_text

YOLO_FILE = "data.yaml"
LABELS = "labels"
DARKNET = "obj_*_data"


def write_yolo(folder: Path, labels: Annotations) -> Path:
    """Write labels; a picture without boxes has an empty file, which means that it is labelled.

    Raises:
        OutputError: A file cannot be written.
    """
    numbers = {name: number for number, name in enumerate(labels.labels)}
    for picture in labels.pictures:
        wide, high = picture.size_px
        lines = []
        for thing, (x0, y0, x1, y1) in picture.boxes():
            box = (x0 + x1) / 2 / wide, (y0 + y1) / 2 / high, (x1 - x0) / wide, (y1 - y0) / high
            lines.append(" ".join([str(numbers[thing.label]), *map(repr, map(float, box))]))
        place = folder / LABELS / f"{Path(picture.name).stem}.txt"
        write_text(place, "".join(f"{line}\n" for line in lines))
    # JSON strings are valid YAML. Without a path, Ultralytics searches the folder of the file.
    names = [f"  {number}: {strict_json(name).strip()}" for name, number in numbers.items()]
    text = ["train: images", "val: images", "names:", *names]
    write_text(folder / YOLO_FILE, "\n".join(text) + "\n")
    return folder / YOLO_FILE


def read_yolo(path: Path, sizes: Sizes) -> Annotations:
    """Read the folder, its ``labels``, or its ``data.yaml``.

    Raises:
        AnnotationError: A file cannot be read, or the size of a picture is unknown.
    """
    folder = path.parent if path.is_file() else path
    parts = [read_box_labels(place, "yolo") for place in _label_folders(folder)]
    pictures = []
    for one in (picture for part in parts for picture in part.pictures):
        stem = Path(one.name).stem
        size = labelled_size(stem, sizes, path)
        things = []
        for thing, box in one.boxes():
            things.append(Annotation(thing.label, _in_pixels(*box, size), place=one.name))
        pictures.append(Picture(stem, size, None, None, tuple(things)))
    classes = dict.fromkeys(name for part in parts for name in part.labels)
    return Annotations(str(path), tuple(classes), tuple(pictures))


def _in_pixels(
    x0: float, y0: float, x1: float, y1: float, size: tuple[int, int]
) -> tuple[float, float, float, float]:
    return x0 * size[0], y0 * size[1], x1 * size[0], y1 * size[1]


def _label_folders(folder: Path) -> list[Path]:
    """Return the folders of label files: those in ``labels`` or Darknet's folders, else here."""
    inside = [one for one in (folder / LABELS, *folder.glob(DARKNET)) if one.is_dir()]
    found = {file.parent for one in inside for file in one.rglob("*.txt")}
    return sorted(found) or inside or [folder]


FIFTYONE_FILE = "labels.json"


def write_fiftyone(folder: Path, labels: Annotations) -> Path:
    """Write labels: boxes as x, y, width and height in fractions of the picture.

    Raises:
        OutputError: The file cannot be written.
    """
    found = {}
    for picture in labels.pictures:
        wide, high = picture.size_px
        things = []
        for thing, (x0, y0, x1, y1) in picture.boxes():
            box = [x0 / wide, y0 / high, (x1 - x0) / wide, (y1 - y0) / high]
            score = {} if thing.score is None else {"confidence": thing.score}
            label = labels.labels.index(thing.label)
            things.append({"label": label, "bounding_box": box} | score)
        found[Path(picture.name).stem] = things
    tree = {"classes": list(labels.labels), "labels": found}
    write_text(folder / FIFTYONE_FILE, strict_json(tree) + "\n")
    return folder / FIFTYONE_FILE


def read_fiftyone(path: Path, sizes: Sizes) -> Annotations:
    """Read ``labels.json``, or the folder that contains it.

    Raises:
        AnnotationError: The file cannot be read, or the size of a picture is unknown.
    """
    file = path / FIFTYONE_FILE if path.is_dir() else path
    tree = read_json(file, MAX_BYTES, AnnotationError, "expected labels")
    by_picture = tree.get("labels") if isinstance(tree, dict) else None
    classes = (tree.get("classes") or []) if isinstance(tree, dict) else []
    if not isinstance(by_picture, dict) or not isinstance(classes, list):
        raise AnnotationError(f"{file}: expected classes and labels, as FiftyOne exports them")
    pictures = []
    for name, rows in by_picture.items():
        stem = Path(name).stem if name.lower().endswith((".jpg", ".png", ".jpeg")) else name
        stem = stem.rpartition("/")[2]
        size = labelled_size(stem, sizes, file)
        things = [_fiftyone_thing(row, classes, size, f"{file}: {name}") for row in rows or ()]
        pictures.append(Picture(stem, size, None, None, tuple(things)))
    used = {thing.label for one in pictures for thing in one.things}
    names = dict.fromkeys([*map(str, classes), *sorted(used)])
    return Annotations(str(file), tuple(names), tuple(pictures))


def _fiftyone_thing(row: Any, classes: list[Any], size: tuple[int, int], where: str) -> Annotation:
    try:
        label, (x, y, w, h) = row["label"], (float(side) for side in row["bounding_box"])
        # FiftyOne writes class numbers if there is a list of classes, else class names.
        name = str(classes[label]) if isinstance(label, int) else str(label)
        score = row.get("confidence")
        box = _in_pixels(x, y, x + w, y + h, size)
        return Annotation(name, box, score=None if score is None else float(score), place=where)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError):
        raise AnnotationError(
            f"{where}: expected label and bounding_box (x, y, width, height as fractions)"
        ) from None


MAX_BYTES: Final = 512 << 20


@dataclass(frozen=True, slots=True)
class LabelFormat:
    """Format of a labelling tool.

    Attributes:
        write: Writes labels to a folder with pictures; returns the file to import into the tool.
        read: Reads a file or folder exported by the tool; boxes in fractions require sizes.
        pictures: Folder of the pictures.
        title: Name for display.
    """

    write: Callable[[Path, Annotations], Path]
    read: Callable[[Path, Sizes], Annotations]
    pictures: str
    title: str


ToolFormat: TypeAlias = Literal["coco", "cvat", "yolo", "fiftyone"]
LABEL_FORMATS: Final[dict[ToolFormat, LabelFormat]] = {
    "coco": LabelFormat(write_coco, lambda path, _: read_coco(path), "images", "COCO"),
    "cvat": LabelFormat(write_cvat, lambda path, _: read_cvat(path), "images", "CVAT 1.1"),
    "yolo": LabelFormat(write_yolo, read_yolo, "images", "YOLO"),
    "fiftyone": LabelFormat(write_fiftyone, read_fiftyone, "data", "FiftyOne"),
}


def read_tool_labels(path: Path, sizes: Sizes, kind: ToolFormat | None = None) -> Annotations:
    """Read the export of a labelling tool.

    Args:
        path: File or folder of the export.
        sizes: Sizes of pictures by name without suffix; ``*`` for all others.
        kind: One of ``LABEL_FORMATS``; detected by default.

    Raises:
        UsageError: The format is unknown, or cannot be detected.
        AnnotationError: The export cannot be read.
    """
    if kind is not None and kind not in LABEL_FORMATS:
        raise UsageError(f"kind: {kind}, expected one of {', '.join(LABEL_FORMATS)}")
    return LABEL_FORMATS[kind or _recognised(path)].read(path, sizes)


def _recognised(path: Path) -> ToolFormat:
    suffix = path.suffix.lower()
    if path.is_dir():
        return "fiftyone" if (path / FIFTYONE_FILE).is_file() else "yolo"
    if suffix in (".xml", ".yaml"):
        return "cvat" if suffix == ".xml" else "yolo"
    if suffix != ".json":
        raise UsageError(f"{path}: expected COCO or FiftyOne (.json), CVAT (.xml), or a folder")
    tree = read_json(path, MAX_BYTES, AnnotationError, "expected labels")
    return "fiftyone" if isinstance(tree, dict) and "labels" in tree else "coco"
