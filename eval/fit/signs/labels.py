"""Labelled pictures of signs, from files of boxes or drives, and a detector scored on them."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.datasets.truth.annotations import Picture, check_boxes
from crosscue.datasets.truth.coco import OBJECTS_FILE, read_coco
from crosscue.datasets.truth.csv_rows import csv_rows
from crosscue.detectors.base import Detections, Detector, Frame
from crosscue.detectors.images import Encoded, decode, encoded, lose, read_file
from crosscue.detectors.training.operating_point import Verdicts, concatenate_verdicts, match_boxes
from crosscue.eval.batch.drive_list import DriveInput, find_drives
from crosscue.replay.base import EVERYTHING
from crosscue.replay.columns import Floats
from crosscue.replay.errors import (
    AnnotationError,
    EmptyResultError,
    LogError,
    MissingTopicError,
    UsageError,
)
from crosscue.replay.ledger import Ledger, warn_of
from crosscue.replay.limits import DEFAULT_LIMITS, Limits
from crosscue.replay.logs.opening import open_log, unless_damaged
from crosscue.replay.signals.extractor import pictures_of
from crosscue.replay.signals.plan import chosen_camera
from crosscue.replay.vehicle.vehicle import Vehicle, load

COLUMNS: Final = ("picture", "label", "x0", "y0", "x1", "y1")
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
    if path.suffix != ".json":
        return _of_csv(path)
    found = []
    for picture, boxes in _coco_boxes(path):
        # Pictures are next to the file, or in a folder ``images`` next to it.
        place = path.parent / picture.name
        place = place if place.exists() else path.parent / "images" / picture.name
        found.append(SignPicture(str(place), place, boxes))
    return found


def _coco_boxes(path: Path) -> Iterator[tuple[Picture, Boxes]]:
    """Yield the pictures of a COCO file with their boxes."""
    read = read_coco(path)
    check_boxes(read)
    if not read.pictures:
        raise EmptyResultError(f"{path}: no picture in it; add some")
    for picture in read.pictures:
        boxes: Boxes = {}
        for thing, box_px in picture.boxes():
            boxes.setdefault(thing.label, []).append(box_px)
        yield picture, boxes


def _of_csv(path: Path) -> list[SignPicture]:
    found: dict[str, SignPicture] = {}
    for where, row in csv_rows(path, ",".join(COLUMNS), remedy=_WANTED):
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


def drive_pictures(folder: Path, limits: Limits = DEFAULT_LIMITS) -> Iterator[SignPicture]:
    """Yield all annotated pictures of a drive's folder, in the order of the log.

    Raises:
        AnnotationError: The folder is not a drive, or has no annotated objects with times.
        LogError: The log cannot be read, or is damaged and has no camera.
        VehicleError: The log has no camera, or several.
    """
    drives = find_drives(folder)
    if len(drives.drives) != 1 or len(drives.drives[0].logs) != 1:
        raise AnnotationError(f"{folder}: expected exactly one log; give the folder of one drive")
    return _pictures(drives.drives[0], _boxes(folder / OBJECTS_FILE), limits)


def _boxes(path: Path) -> dict[int, Boxes]:
    found: dict[int, Boxes] = {}
    for picture, boxes in _coco_boxes(path):
        if picture.t_ns is None:
            raise AnnotationError(f"{path}: images without t_ns; crosscue truth import adds them")
        found[picture.t_ns] = boxes
    return found


def _pictures(drive: DriveInput, boxes: dict[int, Boxes], limits: Limits) -> Iterator[SignPicture]:
    vehicle = load(drive.vehicle) if drive.vehicle else Vehicle(version=1)
    with open_log(Path(drive.logs[0]), limits) as log:
        with unless_damaged([log]):
            camera = chosen_camera([(0, topic) for topic in log.topics], vehicle)
            if camera is None:
                raise MissingTopicError(
                    f"{log.path}: no camera in the log; signs need its pictures"
                )
        ledger = Ledger(str(log.path))
        for block, pictures in pictures_of(log, 0, camera[1], vehicle, ledger, EVERYTHING):
            for i, t_ns in enumerate(block.log_ns.tolist()):
                if t_ns in boxes:
                    name, picture = f"{log.path} at {t_ns}", encoded(pictures, i)
                    drop = partial(lose, ledger, block.topic, t_ns)
                    yield SignPicture(name, picture, boxes[t_ns], drop)
        warn_of(ledger)


@dataclass(frozen=True, slots=True)
class ScoringRules:
    """Rules by which detections are scored.

    Attributes:
        labels: Labels of the signs to find.
        min_overlap: Min intersection over union with the true box.
        min_height_px: Min height of a true sign; smaller ones do not count.
    """

    labels: Sequence[str]
    min_overlap: float
    min_height_px: float = 0.0


def judged_pictures(
    path: Path,
    detector: Detector,
    rules: ScoringRules,
    every: slice,
    limits: Limits = DEFAULT_LIMITS,
) -> Verdicts:
    """Return a detector's detections in pictures of a file or drive, judged by the labels.

    Args:
        path: A file with labels, or a drive's folder.
        detector: Detector of signs.
        rules: Rules of scoring.
        every: Slice of the pictures to use.
        limits: Limits for reading a drive's log.

    Raises:
        UsageError: The file does not exist, or a box is outside its picture.
        LogError: A picture or a drive's log cannot be read.
        SchemaError: A drive has no truth, or its truth is invalid.
    """
    chosen = islice(_labelled(path, limits), every.start, every.stop, every.step)
    return concatenate_verdicts([_judged(one, detector, rules) for one in chosen])


def _labelled(path: Path, limits: Limits) -> Iterator[SignPicture]:
    yield from drive_pictures(path, limits) if path.is_dir() else read_sign_labels(path)


def _judged(one: SignPicture, detector: Detector, rules: ScoringRules) -> Verdicts:
    try:
        picture = read_file(one.picture) if isinstance(one.picture, Path) else one.picture
        pixels, size = decode(picture, detector.view)
    except OSError as error:
        raise LogError(f"{one.name}: {error.strerror}; check the picture column") from None
    except LogError as error:
        if one.lose is not None:
            one.lose(error)
            return concatenate_verdicts([])
        raise type(error)(f"{one.name}: {error}; repair the picture or leave it out") from None
    width, height = size
    found = detector([Frame(0, one.name, pixels, size)])[0]
    if not isinstance(found, Detections):
        raise UsageError("the detector returns no boxes; choose one for signs")
    parts = []
    for label in rules.labels:
        truth: Floats = np.array(one.boxes.get(label, []), np.float64).reshape(-1, 4)
        if len(truth) and (truth.min() < -1 or (truth[:, 2:] > (width + 1, height + 1)).any()):
            raise UsageError(
                f"{one.name}: a box lies outside its {width} x {height} px; correct it"
            )
        which = np.array([name == label for name in found.labels], np.bool_)
        boxes_px, scores = found.boxes_px[which], found.scores[which]
        counts = truth[:, 3] - truth[:, 1] >= rules.min_height_px
        parts.append(match_boxes(boxes_px, scores, truth, rules.min_overlap, counts))
    return concatenate_verdicts(parts)
