"""Read and write COCO annotation files: objects with boxes in pictures."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from crosscue.detectors.training.annotations import coco_rows, coco_tree
from crosscue.replay.errors import AnnotationError
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.limits import MIB

from .annotations import Annotation, Annotations, Picture, PictureTimes

MAX_BYTES: Final = 512 * MIB
MAX_SIDE: Final = 100_000
WRITTEN: Final = "annotations.json"


def read_coco(path: Path) -> Annotations:
    """Read a COCO file; pictures may have ``t_ns``, their log time.

    Raises:
        AnnotationError: The file does not exist, is not COCO, or has invalid references.
    """
    tree = coco_tree(path, MAX_BYTES)
    labels = _labels(tree, path)
    pictures = _pictures(tree, path)
    things: dict[int, list[Annotation]] = {number: [] for number in pictures}
    for place, row in enumerate(coco_rows(tree, "annotations", path)):
        where = f"annotations.{place}"
        image, label = _key(row.get("image_id")), labels.get(_key(row.get("category_id")))
        if image not in things:
            raise AnnotationError(
                f"{path}: {where}: image_id {row.get('image_id')!r}: no such image; correct it"
            )
        if label is None:
            raise AnnotationError(
                f"{path}: {where}: category_id {row.get('category_id')!r}: no such category"
            )
        things[image].append(_thing(row, label, where, path))
    names = tuple(labels.values())
    return Annotations(
        str(path),
        names,
        tuple(
            Picture(one.name, one.size_px, one.t_ns, None, tuple(things[number]))
            for number, one in pictures.items()
        ),
    )


def _key(value: object) -> int:
    """Return an id, or an id that no row has if the value is not an id."""
    return value if isinstance(value, int) and not isinstance(value, bool) else -1


def _labels(tree: Mapping[str, Any], path: Path) -> dict[int, str]:
    labels: dict[int, str] = {}
    for place, row in enumerate(coco_rows(tree, "categories", path)):
        number, name = _key(row.get("id")), row.get("name")
        if number < 0 or number in labels or not isinstance(name, str) or name in labels.values():
            raise AnnotationError(
                f"{path}: categories.{place}: expected a unique id and a unique name; correct it"
            )
        labels[number] = name
    return labels


def _pictures(tree: Mapping[str, Any], path: Path) -> dict[int, Picture]:
    pictures: dict[int, Picture] = {}
    for place, row in enumerate(coco_rows(tree, "images", path)):
        where = f"{path}: images.{place}"
        number, name, t_ns = _key(row.get("id")), row.get("file_name"), row.get("t_ns")
        if number < 0 or number in pictures or not isinstance(name, str):
            raise AnnotationError(f"{where}: expected a unique id and a file_name; correct it")
        size = (_key(row.get("width")), _key(row.get("height")))
        if not (0 < size[0] <= MAX_SIDE and 0 < size[1] <= MAX_SIDE):
            raise AnnotationError(
                f"{where}: width and height: expected whole pixels, 1 to {MAX_SIDE}"
            )
        if t_ns is not None and not (_key(t_ns) == t_ns and 0 <= t_ns < 2**62):
            raise AnnotationError(f"{where}: t_ns {t_ns!r}: expected whole nanoseconds; correct it")
        pictures[number] = Picture(name, size, t_ns)
    return pictures


def _thing(row: Mapping[str, Any], label: str, where: str, path: Path) -> Annotation:
    box = row.get("bbox")
    if not (isinstance(box, list) and len(box) == 4 and all(_is_number(value) for value in box)):
        raise AnnotationError(
            f"{path}: {where}: bbox {box!r}: expected four numbers x, y, w, h; correct it"
        )
    x, y, w, h = (float(value) for value in box)
    visible, track = row.get("visible"), row.get("track_id")
    if visible is not None and not (_is_number(visible) and 0.0 <= visible <= 1.0):
        raise AnnotationError(f"{path}: {where}: visible {visible!r}: expected 0 to 1; correct it")
    range_m = row.get("range_m")
    if range_m is not None and not (_is_number(range_m) and range_m >= 0.0):
        raise AnnotationError(f"{path}: {where}: range_m {range_m!r}: expected metres; correct it")
    return Annotation(
        label=label,
        box_px=(x, y, x + w, y + h),
        is_crowd=bool(row.get("iscrowd")),
        visible=None if visible is None else float(visible),
        track=None if track is None else _key(track),
        segmentation=row.get("segmentation"),
        place=where,
        range_m=None if range_m is None else float(range_m),
    )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@dataclass(slots=True)
class CocoRows:
    """Rows of a COCO file: pictures, and the boxes in them."""

    images: list[dict[str, Any]] = field(default_factory=list)
    annotations: list[dict[str, Any]] = field(default_factory=list)

    def add_image(self, file_name: str, size_px: tuple[int, int], **more: object) -> None:
        """Add a picture, to which the boxes added afterwards belong; ``more`` are further keys."""
        wide, high = size_px
        row = {"id": len(self.images) + 1, "file_name": file_name, "width": wide, "height": high}
        self.images.append(row | more)

    def add_box(
        self, category: int, box_px: tuple[float, float, float, float], **more: object
    ) -> None:
        """Add a box, x0, y0, x1, y1, to the last picture; ``more`` are further keys."""
        x0, y0, x1, y1 = box_px
        row = {
            "id": len(self.annotations) + 1,
            "image_id": self.images[-1]["id"],
            "category_id": category,
            "bbox": [x0, y0, x1 - x0, y1 - y0],
            "area": (x1 - x0) * (y1 - y0),
            "iscrowd": 0,
        }
        self.annotations.append(row | more)

    def write(self, path: Path, source: str, numbers: Mapping[str, int]) -> Path:
        """Write the file with categories of these numbers, and return its path.

        Raises:
            OutputError: It cannot be written.
        """
        tree = {
            "info": {"description": source},
            "images": self.images,
            "annotations": self.annotations,
            "categories": [{"id": number, "name": name} for name, number in numbers.items()],
        }
        write_text(path, strict_json(tree) + "\n")
        return path


def write_coco(folder: Path, labels: Annotations) -> Path:
    """Write a COCO file with times of pictures and scores of boxes, and return its path.

    Raises:
        OutputError: The file cannot be written.
    """
    numbers = {name: number for number, name in enumerate(labels.labels, 1)}
    rows = CocoRows()
    for picture in labels.pictures:
        t_ns = {} if picture.t_ns is None else {"t_ns": picture.t_ns}
        rows.add_image(picture.name, picture.size_px, **t_ns)
        for thing, box_px in picture.boxes():
            score = {} if thing.score is None else {"score": thing.score}
            rows.add_box(numbers[thing.label], box_px, iscrowd=int(thing.is_crowd), **score)
    return rows.write(folder / WRITTEN, labels.where, numbers)


def write_imported(
    path: Path, annotations: Annotations, placed: PictureTimes, cues: Mapping[str, str | None]
) -> Path:
    """Write the labelled objects, with log times of pictures and names of cues.

    Raises:
        OutputError: The file cannot be written.
    """
    plain = {
        label: label if (cue := cues[label]) is None else cue.replace("_", " ")
        for label in annotations.labels
    }
    names = {name: number for number, name in enumerate(dict.fromkeys(plain.values()), start=1)}
    rows = CocoRows()
    for picture, t_ns in zip(annotations.pictures, placed.t_ns, strict=True):
        rows.add_image(picture.name, picture.size_px, t_ns=t_ns)
        for thing, box_px in picture.boxes():
            found = {"visible": thing.visible, "track_id": thing.track}
            found["segmentation"] = thing.segmentation
            known = {name: value for name, value in found.items() if value is not None}
            number = names[plain[thing.label]]
            rows.add_box(number, box_px, iscrowd=int(thing.is_crowd), **known)
    return rows.write(path, f"imported from {annotations.where}", names)


OBJECTS_FILE: Final = "objects.json"

# COCO's category numbers; other labels are numbered from 200.
COCO_IDS: Final = {
    "person": 1, "bicycle": 2, "car": 3, "motorcycle": 4, "bus": 6, "train": 7, "truck": 8,
}  # fmt: skip


@dataclass(slots=True)
class Objects(CocoRows):
    """Collection of boxes in a data set's pictures, in the order of pictures."""

    labels: dict[str, int] = field(default_factory=dict)

    def add(self, label: str, box_px: tuple[float, float, float, float], **more: object) -> None:
        """Add a box, x0, y0, x1, y1, to the last picture, clipped to the picture.

        Args:
            label: Label, which is COCO's name if COCO has the class.
            box_px: Box, which is omitted if it is completely outside the picture.
            more: Further keys of its row.
        """
        image = self.images[-1]
        x0, x1 = (min(max(x, 0.0), image["width"]) for x in (box_px[0], box_px[2]))
        y0, y1 = (min(max(y, 0.0), image["height"]) for y in (box_px[1], box_px[3]))
        if x1 - x0 < 1.0 or y1 - y0 < 1.0:
            return
        number = self.labels.setdefault(label, COCO_IDS.get(label, 200 + len(self.labels)))
        rounded = {
            "bbox": [round(x0, 2), round(y0, 2), round(x1 - x0, 2), round(y1 - y0, 2)],
            "area": round((x1 - x0) * (y1 - y0), 1),
        }
        self.add_box(number, (x0, y0, x1, y1), **rounded | more)

    def save(self, folder: Path, source: str) -> str:
        """Write the file next to a truth file, and return its name.

        Raises:
            OutputError: It cannot be written.
        """
        return self.write(folder / OBJECTS_FILE, source, self.labels).name
