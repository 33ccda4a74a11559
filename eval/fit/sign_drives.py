"""The pictures of a drive with the signs that its truth has in them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from crosscue.detectors.images import Encoded, encoded
from crosscue.eval.batch.drive_list import DriveInput, drives_of
from crosscue.replay.base import (
    DEFAULT_LIMITS,
    MIB,
    AnnotationError,
    Block,
    Images,
    Ledger,
    Limits,
    Log,
    LogError,
    Selection,
    read_at_most,
)
from crosscue.replay.losses import warn_of
from crosscue.replay.opening import open_log
from crosscue.replay.signals.extractor import Extractor, probe_clocks
from crosscue.replay.signals.kinds import Plan, Source
from crosscue.replay.signals.plan import camera_of
from crosscue.replay.vehicle.vehicle import Vehicle, load

from .sign_labels import Boxes, Labelled, coco_boxes
from .truth_check import OBJECTS

MAX_BYTES: Final = 512 * MIB


def drive_pictures(folder: Path, limits: Limits = DEFAULT_LIMITS) -> Iterator[Labelled]:
    """All annotated pictures of a drive's folder, in the order of the log.

    Raises:
        AnnotationError: The folder is no drive's, or has no annotated objects with times.
        LogError: The log cannot be read, or has no camera.
    """
    drives = drives_of([str(folder)])
    if len(drives.drives) != 1 or len(drives.drives[0].logs) != 1:
        raise AnnotationError(f"{folder}: holds not one log; give the folder of one drive")
    return _pictures(drives.drives[0], _boxes(folder / OBJECTS), limits)


def _boxes(path: Path) -> dict[int, Boxes]:
    try:
        content = read_at_most(path, MAX_BYTES)
        if content is None:
            raise AnnotationError(f"{path}: over {MAX_BYTES // MIB} MiB; split the drive")
        text = content.decode("utf-8")
    except OSError as error:
        raise AnnotationError(
            f"{path}: {error.strerror}; labels of a drive's signs stand there"
        ) from None
    except UnicodeDecodeError:
        raise AnnotationError(
            f"{path}: is no text; labels of a drive's signs stand there"
        ) from None
    found: dict[int, Boxes] = {}
    for image, boxes in coco_boxes(text, path):
        if not isinstance(image.get("t_ns"), int):
            raise AnnotationError(f"{path}: images without t_ns; crosscue truth import gives them")
        found[image["t_ns"]] = boxes
    return found


def _pictures(drive: DriveInput, boxes: dict[int, Boxes], limits: Limits) -> Iterator[Labelled]:
    vehicle = load(drive.vehicle) if drive.vehicle else Vehicle(version=1)
    with open_log(Path(drive.logs[0]), limits) as log:
        for t_ns, picture in _camera(log, vehicle):
            if t_ns in boxes:
                name = f"{log.path} at {t_ns}"
                yield Labelled(name, picture, boxes[t_ns])


def _camera(log: Log, vehicle: Vehicle) -> Iterator[tuple[int, Encoded]]:
    camera = camera_of([(0, topic) for topic in log.topics], vehicle)
    if camera is None:
        raise LogError(f"{log.path}: no camera in the log; signs need its pictures")
    planned = Plan((Source(0, camera[1], ()),), {})
    wanted = Selection(frozenset({camera[1].name}))
    clocks = probe_clocks(log, planned, vehicle, 0, wanted)
    waiting: list[Block] = []
    extractor = Extractor(
        planned, vehicle, 0, Ledger(str(log.path)), clocks, on_pictures=waiting.append
    )
    for block in log.read(extractor.ledger, wanted):
        for _ in extractor(block):
            pass
        for pictures in waiting:
            if isinstance(pictures.rows, Images):
                for i, t_ns in enumerate(pictures.log_ns.tolist()):
                    yield t_ns, encoded(pictures.rows, i)
        waiting.clear()
    warn_of(extractor.ledger)
