"""Times and size of the pictures of a log's camera, on the clock that runs use."""

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crosscue.datasets.truth.annotations import LogPictures
from crosscue.detectors.images import check, encoded, lose
from crosscue.replay.base import EVERYTHING
from crosscue.replay.columns import Int64s
from crosscue.replay.errors import EmptyResultError, LogError, MissingTopicError
from crosscue.replay.ledger import Ledger, warn_of
from crosscue.replay.limits import DEFAULT_LIMITS, Limits
from crosscue.replay.logs.opening import open_log, unless_damaged
from crosscue.replay.readers.images.folder import picture_names
from crosscue.replay.signals.extractor import pictures_of
from crosscue.replay.signals.plan import chosen_camera
from crosscue.replay.time.stamp_watch import StampWatch
from crosscue.replay.vehicle.vehicle import Vehicle


def log_pictures(path: Path, vehicle: Vehicle, limits: Limits = DEFAULT_LIMITS) -> LogPictures:
    """Return times and size of the pictures of a log's only camera; warn about dropped rows.

    The size is that of the first usable picture. The times include unusable pictures, so that
    numbers of frames stay right.

    Raises:
        EmptyResultError: The log has no usable picture.
        LogError: The log cannot be read.
        VehicleError: The log has no camera, or several.
    """
    with open_log(path, limits) as log, unless_damaged([log]):
        camera = chosen_camera([(0, topic) for topic in log.topics], vehicle)
        if camera is None:
            raise MissingTopicError(f"{path}: no camera in the log; annotations need its pictures")
        topic = camera[1]
        ledger = Ledger(str(path))
        times: list[Int64s] = []
        size: tuple[int, int] | None = None
        for block, pictures in pictures_of(log, 0, topic, vehicle, ledger, EVERYTHING):
            times.append(block.log_ns)
            for row, t_ns in enumerate(block.log_ns.tolist()):
                try:
                    found = check(encoded(pictures, row))
                    size = size or found
                except LogError as error:
                    lose(ledger, topic.name, t_ns, error)
        warn_of(ledger)
        if size is None:
            raise EmptyResultError(
                f"{path}: {topic.name}: no usable picture; annotations need pictures"
            )
        names = picture_names(log)
    return LogPictures(str(path), np.unique(np.concatenate(times)), size, names)


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
