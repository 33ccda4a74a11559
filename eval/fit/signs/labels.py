"""Labelled pictures of signs, from a CSV file of boxes or a COCO file."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from crosscue.detectors.images import Encoded
from crosscue.replay.errors import AnnotationError, EmptyResultError, LogError
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.files.tree_text import json_tree
from crosscue.replay.limits import MIB

COLUMNS: Final = ("picture", "label", "x0", "y0", "x1", "y1")
MAX_BYTES: Final = 64 * MIB
_WANTED: Final = "give a CSV or COCO file of boxes, or a drive's folder"

# Boxes (x0, y0, x1, y1) in pixels by label.
Boxes = dict[str, list[tuple[float, float, float, float]]]


@dataclass(frozen=True, slots=True)
class SignPicture:
    """One picture and its true signs.

    Attributes:
        name: Readable name, for messages.
        picture: Content of the picture, or its path.
        boxes: Boxes of its signs.
        lose: Called if a picture of a log cannot be used; None for a file, which must be readable.
    """

    name: str
    picture: Path | Encoded
    boxes: Boxes
    lose: Callable[[LogError], None] | None = None


def read_sign_labels(path: Path) -> list[SignPicture]:
    """Read a COCO file (.json) or a CSV file; an empty CSV label marks a picture without signs.

    Raises:
        AnnotationError: The file does not exist or is invalid; the message names the line.
    """
    text = read_text(path)
    return _of_coco(text, path) if path.suffix == ".json" else _of_csv(text, path)


def read_text(path: Path, max_bytes: int = MAX_BYTES) -> str:
    """Read a file of labels.

    Raises:
        AnnotationError: It cannot be read, is larger than ``max_bytes``, or is not text.
    """
    try:
        content = read_at_most(path, max_bytes)
        if content is None:
            raise AnnotationError(f"{path}: over {max_bytes // MIB} MiB; split it")
        return content.decode("utf-8")
    except OSError as error:
        raise AnnotationError(f"{path}: {error.strerror}; {_WANTED}") from None
    except UnicodeDecodeError:
        raise AnnotationError(f"{path}: is not text; {_WANTED}") from None


def _of_coco(text: str, path: Path) -> list[SignPicture]:
    """Read a COCO file whose pictures are next to it or in a folder ``images`` next to it."""
    found = []
    for image, boxes in coco_boxes(text, path):
        try:
            place = path.parent / image["file_name"]
            place = place if place.exists() else path.parent / "images" / image["file_name"]
        except (KeyError, TypeError) as error:
            raise AnnotationError(f"{path}: no COCO file ({error!r}); correct it") from None
        found.append(SignPicture(str(place), place, boxes))
    return found


def coco_boxes(text: str, path: Path) -> list[tuple[dict[str, Any], Boxes]]:
    """Return the images of a COCO file with their boxes, by id.

    Raises:
        AnnotationError: The file is not COCO, has no image, or has an invalid box.
    """
    try:
        tree = json_tree(text)
        names = {one["id"]: str(one["name"]) for one in tree["categories"]}
        found: dict[int, tuple[dict[str, Any], Boxes]] = {
            image["id"]: (image, {}) for image in tree["images"]
        }
        for one in tree["annotations"]:
            x, y, wide, high = (float(number) for number in one["bbox"])
            box = (x, y, x + wide, y + high)
            if not all(map(math.isfinite, box)) or wide <= 0.0 or high <= 0.0:
                raise AnnotationError(
                    f"{path}: annotation {one['id']}: box {box}: expected positive width and height"
                )
            found[one["image_id"]][1].setdefault(names[one["category_id"]], []).append(box)
    except (ValueError, KeyError, TypeError) as error:
        raise AnnotationError(f"{path}: no COCO file ({error!r}); correct it") from None
    if not found:
        raise EmptyResultError(f"{path}: no picture in it; add some")
    return [found[number] for number in sorted(found)]


def _of_csv(text: str, path: Path) -> list[SignPicture]:
    reader = csv.DictReader(text.splitlines())
    if reader.fieldnames is None or set(COLUMNS) - set(reader.fieldnames):
        raise AnnotationError(f"{path}:1: expected the columns {','.join(COLUMNS)}")
    found: dict[str, SignPicture] = {}
    for row in reader:
        where = f"{path}:{reader.line_num}"
        name = row["picture"] or ""
        place = path.parent / name
        one = found.setdefault(name, SignPicture(str(place), place, {}))
        if row["label"]:
            one.boxes.setdefault(row["label"], []).append(_box(row, where))
    if not found:
        raise EmptyResultError(f"{path}: no picture in it; add rows")
    return [found[name] for name in sorted(found)]


def _box(row: dict[str, str], where: str) -> tuple[float, float, float, float]:
    try:
        x0, y0, x1, y1 = (float(row[name]) for name in COLUMNS[2:])
    except (TypeError, ValueError):
        raise AnnotationError(f"{where}: expected four numbers x0,y0,x1,y1") from None
    if not all(map(math.isfinite, (x0, y0, x1, y1))) or x0 >= x1 or y0 >= y1:
        raise AnnotationError(f"{where}: box {x0}, {y0}, {x1}, {y1}: expected x0 < x1 and y0 < y1")
    return x0, y0, x1, y1
