"""Labelled pictures of signs: a CSV file of boxes, and which half a picture is in."""

from __future__ import annotations

import csv
import math
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
    """Read the file; a row with an empty label says that the picture has no sign.

    Raises:
        UsageError: Not there, not such a file, or a box that is none; with the line.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise UsageError(f"{path}: over {MOST_BYTES // MIB} MiB; split it")
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: {error}; give a CSV file of boxes") from None
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
    pictures: list[Labelled], detector: Detector, label: str, least_overlap: float
) -> Judged:
    """What a detector finds of one label in labelled pictures, and what of it is right.

    Raises:
        UsageError: A picture that cannot be read, or a box outside its picture.
        LogFormatError: One that does not decode.
    """
    return together([_judged(one, detector, label, least_overlap) for one in pictures])


def _judged(one: Labelled, detector: Detector, label: str, least_overlap: float) -> Judged:
    frame = _frame(one.path, detector)
    truth: Floats = np.array(one.boxes.get(label, []), np.float64).reshape(-1, 4)
    width, height = frame.size_px
    if len(truth) and (truth.min() < -1 or (truth[:, 2:] > (width + 1, height + 1)).any()):
        raise UsageError(f"{one.path}: a box lies outside its {width} x {height} px; mend it")
    found = detector([frame])[0]
    if not isinstance(found, Detections):
        raise UsageError("the detector gives no boxes; choose one for signs")
    which = np.array([name == label for name in found.labels], np.bool_)
    return judge(found.boxes_px[which], found.scores[which], truth, least_overlap)


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
