"""Pictures of a drive, labelled with the signs of its truth."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Final

from crosscue.datasets.truth.coco import OBJECTS_FILE
from crosscue.detectors.images import encoded, lose
from crosscue.eval.batch.drive_list import DriveInput, drives_of
from crosscue.eval.fit.signs.labels import Boxes, SignPicture, coco_boxes, read_text
from crosscue.replay.base import EVERYTHING
from crosscue.replay.errors import AnnotationError, MissingTopicError
from crosscue.replay.ledger import Ledger, warn_of
from crosscue.replay.limits import DEFAULT_LIMITS, MIB, Limits
from crosscue.replay.logs.opening import open_log, unless_damaged
from crosscue.replay.signals.extractor import pictures_of
from crosscue.replay.signals.plan import chosen_camera
from crosscue.replay.vehicle.vehicle import Vehicle, load

MAX_BYTES: Final = 512 * MIB


def drive_pictures(folder: Path, limits: Limits = DEFAULT_LIMITS) -> Iterator[SignPicture]:
    """Yield all annotated pictures of a drive's folder, in the order of the log.

    Raises:
        AnnotationError: The folder is not a drive, or has no annotated objects with times.
        LogError: The log cannot be read, or is damaged and has no camera.
        VehicleError: The log has no camera, or several.
    """
    drives = drives_of([str(folder)])
    if len(drives.drives) != 1 or len(drives.drives[0].logs) != 1:
        raise AnnotationError(f"{folder}: expected exactly one log; give the folder of one drive")
    return _pictures(drives.drives[0], _boxes(folder / OBJECTS_FILE), limits)


def _boxes(path: Path) -> dict[int, Boxes]:
    found: dict[int, Boxes] = {}
    for image, boxes in coco_boxes(read_text(path, MAX_BYTES), path):
        if not isinstance(image.get("t_ns"), int):
            raise AnnotationError(f"{path}: images without t_ns; crosscue truth import adds them")
        found[image["t_ns"]] = boxes
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
