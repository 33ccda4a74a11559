"""Times and size of the pictures of a log's camera, on the clock that runs use."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crosscue.datasets.truth.annotations import LogPictures
from crosscue.detectors.images import encoded, size_of
from crosscue.replay.base import (
    DEFAULT_LIMITS,
    EVERYTHING,
    Block,
    Images,
    Int64s,
    Ledger,
    Limits,
    LogError,
    MissingTopicError,
    warn_of,
)
from crosscue.replay.logs.opening import open_log, unless_damaged
from crosscue.replay.readers.images.folder import picture_names
from crosscue.replay.signals.extractor import pictures_of
from crosscue.replay.signals.plan import camera_of
from crosscue.replay.time.stamp_watch import StampWatch
from crosscue.replay.vehicle.vehicle import Vehicle


def log_pictures(path: Path, vehicle: Vehicle, limits: Limits = DEFAULT_LIMITS) -> LogPictures:
    """Return times and size of the pictures of a log's only camera; warn about dropped rows.

    Raises:
        LogError: The log or its first picture cannot be read.
        VehicleError: The log has no camera, or several.
    """
    with open_log(path, limits) as log, unless_damaged([log]):
        camera = camera_of([(0, topic) for topic in log.topics], vehicle)
        if camera is None:
            raise MissingTopicError(f"{path}: no camera in the log; annotations need its pictures")
        topic = camera[1]
        ledger = Ledger(str(path))
        times: list[Int64s] = []
        size: tuple[int, int] | None = None
        for block, pictures in pictures_of(log, 0, topic, vehicle, ledger, EVERYTHING):
            times.append(block.log_ns)
            size = size or _size_of(block, pictures, f"{path}: {topic.name}")
        warn_of(ledger)
        if size is None:
            raise LogError(f"{path}: {topic.name}: not one picture; annotations need them")
        names = picture_names(log)
    return LogPictures(str(path), np.unique(np.concatenate(times)), size, names)


def _size_of(block: Block, pictures: Images, where: str) -> tuple[int, int]:
    """Return the size of the first picture, which the annotations must match."""
    try:
        return size_of(encoded(pictures, 0))
    except LogError as error:
        raise type(error)(
            f"{where}: first picture, at {block.log_ns[0]}ns: {error}; annotations need its size"
        ) from None


@dataclass(frozen=True, slots=True)
class LogSpan:
    """Time span of a log's rows, on its own clock.

    Attributes:
        start_ns: The first stamp.
        end_ns: One nanosecond after the last stamp.
        was_set_back: True if the clock was set back, so that the drive lasts longer than its
            stamps suggest.
    """

    start_ns: int
    end_ns: int
    was_set_back: bool


def log_span(path: Path, limits: Limits = DEFAULT_LIMITS) -> LogSpan:
    """Return the time span of a log's rows.

    Raises:
        LogError: The log cannot be read, or has no row.
    """
    first, last, ledger = 2**63 - 1, -(2**63), Ledger(str(path))
    watches: defaultdict[str, StampWatch] = defaultdict(StampWatch)
    with open_log(path, limits) as log:
        for block in log.read(ledger):
            if len(block):
                watches[block.topic].add(block.log_ns)
                first, last = (
                    min(first, int(block.log_ns.min())),
                    max(last, int(block.log_ns.max())),
                )
    warn_of(ledger)
    if last < first:
        raise LogError(f"{path}: holds no row")
    for watch in watches.values():
        watch.finish()
    return LogSpan(first, last + 1, any(watch.set_backs for watch in watches.values()))
