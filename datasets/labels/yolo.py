"""Read and write YOLO labels as Ultralytics does: ``data.yaml``, ``labels/NAME.txt``, ``images``.

Subsets in separate folders (``labels/train``), as exported by FiftyOne and CVAT, can also be read,
and so can Darknet's ``obj_train_data``, CVAT's "YOLO 1.1".
"""

from __future__ import annotations

from pathlib import Path

from crosscue.datasets.truth.annotations import (
    Annotation,
    Annotations,
    Picture,
    Sizes,
    labelled_size,
)
from crosscue.datasets.truth.box_labels import read_box_labels
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_text

FILE = "data.yaml"
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
        for thing in picture.things:
            if thing.box_px is not None:
                x0, y0, x1, y1 = thing.box_px
                box = (x0 + x1) / 2 / wide, (y0 + y1) / 2 / high, (x1 - x0) / wide, (y1 - y0) / high
                lines.append(" ".join([str(numbers[thing.label]), *map(repr, map(float, box))]))
        place = folder / LABELS / f"{Path(picture.name).stem}.txt"
        write_text(place, "".join(f"{line}\n" for line in lines))
    # JSON strings are valid YAML. Without a path, Ultralytics searches the folder of the file.
    names = [f"  {number}: {strict_json(name).strip()}" for name, number in numbers.items()]
    text = ["train: images", "val: images", "names:", *names]
    write_text(folder / FILE, "\n".join(text) + "\n")
    return folder / FILE


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
        for box in one.boxes:
            x0, y0, x1, y1 = box.box
            in_px = (x0 * size[0], y0 * size[1], x1 * size[0], y1 * size[1])
            things.append(Annotation(box.label, in_px, place=one.name))
        pictures.append(Picture(stem, size, None, None, tuple(things)))
    classes = dict.fromkeys(name for part in parts for name in part.classes)
    return Annotations(str(path), tuple(classes), tuple(pictures))


def _label_folders(folder: Path) -> list[Path]:
    """Return the folders of label files: those in ``labels`` or Darknet's folders, else here."""
    inside = [one for one in (folder / LABELS, *folder.glob(DARKNET)) if one.is_dir()]
    found = {file.parent for one in inside for file in one.rglob("*.txt")}
    return sorted(found) or inside or [folder]
