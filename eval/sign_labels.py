"""Labelled pictures of signs, from a CSV file of boxes or a COCO file."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.detectors.base import Detections, Detector, Frame
from crosscue.detectors.pictures import Encoded, decode
from crosscue.detectors.sign_threshold import Judged, judge, together
from crosscue.replay.columns import Floats
from crosscue.replay.decode.coding import MAGIC_BYTES, coding_of
from crosscue.replay.errors import UsageError
from crosscue.replay.limits import DEFAULT, MIB

COLUMNS: Final = ("picture", "label", "x0", "y0", "x1", "y1")
MOST_BYTES: Final = 64 * MIB


@dataclass(frozen=True, slots=True)
class Labelled:
    """One picture and its true signs.

    Attributes:
        path: Of the picture.
        boxes: From label to boxes (x0, y0, x1, y1) in pixels.
    """

    path: Path
    boxes: dict[str, list[tuple[float, float, float, float]]]


def read_labels(path: Path) -> list[Labelled]:
    """Read a CSV file, where an empty label says that the picture has no sign, or COCO (.json).

    Raises:
        UsageError: Not there, not such a file, or a box that is none; with the line.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise UsageError(f"{path}: over {MOST_BYTES // MIB} MiB; split it")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: {error}; give a CSV or COCO file of boxes") from None
    return _of_coco(text, path) if path.suffix == ".json" else _of_csv(text.splitlines(), path)


def _of_coco(text: str, path: Path) -> list[Labelled]:
    """Pictures lie beside the file or in a folder ``images`` beside it."""
    try:
        tree = json.loads(text)
        names = {one["id"]: str(one["name"]) for one in tree["categories"]}
        found: dict[int, Labelled] = {}
        for image in tree["images"]:
            place = path.parent / image["file_name"]
            place = place if place.exists() else path.parent / "images" / image["file_name"]
            found[image["id"]] = Labelled(place, {})
        for one in tree["annotations"]:
            x, y, wide, high = (float(number) for number in one["bbox"])
            box = (x, y, x + wide, y + high)
            if not all(map(math.isfinite, box)) or wide <= 0.0 or high <= 0.0:
                raise UsageError(f"{path}: annotation {one['id']}: box {box}: want a real one")
            label = names[one["category_id"]]
            found[one["image_id"]].boxes.setdefault(label, []).append(box)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise UsageError(f"{path}: no COCO file ({error!r}); mend it") from None
    if not found:
        raise UsageError(f"{path}: no picture in it; add some")
    return [found[number] for number in sorted(found)]


def _of_csv(lines: list[str], path: Path) -> list[Labelled]:
    reader = csv.DictReader(lines)
    if reader.fieldnames is None or set(COLUMNS) - set(reader.fieldnames):
        raise UsageError(f"{path}:1: want the columns {','.join(COLUMNS)}")
    found: dict[str, Labelled] = {}
    for row in reader:
        where = f"{path}:{reader.line_num}"
        name = row["picture"] or ""
        labelled = found.setdefault(name, Labelled(path.parent / name, {}))
        if row["label"]:
            labelled.boxes.setdefault(row["label"], []).append(_box(row, where))
    if not found:
        raise UsageError(f"{path}: no picture in it; add rows")
    return [found[name] for name in sorted(found)]


def _box(row: dict[str, str], where: str) -> tuple[float, float, float, float]:
    try:
        x0, y0, x1, y1 = (float(row[name]) for name in COLUMNS[2:])
    except (TypeError, ValueError):
        raise UsageError(f"{where}: want four numbers x0,y0,x1,y1") from None
    if not all(map(math.isfinite, (x0, y0, x1, y1))) or x0 >= x1 or y0 >= y1:
        raise UsageError(f"{where}: box {x0}, {y0}, {x1}, {y1}: want x0 < x1 and y0 < y1")
    return x0, y0, x1, y1


def judged_pictures(
    pictures: list[Labelled], detector: Detector, labels: Sequence[str], least_overlap: float
) -> Judged:
    """What a detector finds of some labels in labelled pictures, and what of it is right.

    Raises:
        UsageError: A picture that cannot be read, or a box outside its picture.
        LogFormatError: One that does not decode.
    """
    return together([_judged(one, detector, labels, least_overlap) for one in pictures])


def _judged(
    one: Labelled, detector: Detector, labels: Sequence[str], least_overlap: float
) -> Judged:
    frame = _frame(one.path, detector)
    width, height = frame.size_px
    found = detector([frame])[0]
    if not isinstance(found, Detections):
        raise UsageError("the detector gives no boxes; choose one for signs")
    parts = []
    for label in labels:
        truth: Floats = np.array(one.boxes.get(label, []), np.float64).reshape(-1, 4)
        if len(truth) and (truth.min() < -1 or (truth[:, 2:] > (width + 1, height + 1)).any()):
            raise UsageError(f"{one.path}: a box lies outside its {width} x {height} px; mend it")
        which = np.array([name == label for name in found.labels], np.bool_)
        parts.append(judge(found.boxes_px[which], found.scores[which], truth, least_overlap))
    return together(parts)


def _frame(path: Path, detector: Detector) -> Frame:
    try:
        with path.open("rb") as file:
            content = file.read(DEFAULT.message_bytes)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}; check the picture column") from None
    coding = coding_of(content[:MAGIC_BYTES], "")
    if coding is None:
        raise UsageError(f"{path}: not a JPEG, PNG or WebP picture")
    pixels, size = decode(Encoded(coding, memoryview(content)), detector.view)
    return Frame(0, path.name, pixels, size)
