"""The pictures of a run, read again from its log, on the clock that the run's tables have."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.detectors.images import Encoded, encoded
from crosscue.eval.runs.folder import DetectManifest, RunFolder
from crosscue.replay.base import (
    DEFAULT_LIMITS,
    Block,
    Images,
    Ledger,
    Limits,
    RunError,
    Selection,
    Topic,
    UnreadableRunError,
    warn_of,
)
from crosscue.replay.clocks.clock import Clock
from crosscue.replay.logs.opening import open_log
from crosscue.replay.signals.extractor import Extractor
from crosscue.replay.signals.kinds import Plan, Source
from crosscue.replay.time.segments import UNSHIFTED, LogClock, TimedLog
from crosscue.replay.vehicle.vehicle import Vehicle

from .logs import place_of

AROUND_NS: Final = 2_000_000_000
"""A picture's own clock and the log's may differ by this much."""


@dataclass(frozen=True, slots=True)
class StoredCamera:
    """Where a run's pictures lie.

    Attributes:
        log: Path or URL.
        topic: In it.
        clock: Whose times the run's tables have.
        selection: What part of the log the run examined.
        time: The log's clock against the times of the run's tables.
        limits: What the log is read with.
    """

    log: Path | str
    topic: Topic
    clock: Clock
    selection: Selection
    time: LogClock = UNSHIFTED
    limits: Limits = DEFAULT_LIMITS


def camera_of(run: RunFolder) -> StoredCamera | None:
    """The camera; None where the run's logs have none, or several and no line says which.

    Raises:
        RunError: The manifest cannot be read; its log is gone, or another is in its place.
        LogError: The log cannot be opened.
    """
    if run.without_images:
        return None
    manifest = run.drive_manifest()
    detected = manifest.detected
    named = manifest.settings.topics.camera if detected is None else detected.camera
    cameras = [
        (number, entry, name)
        for number, entry in enumerate(manifest.logs)
        for name in entry.cameras
        if named in (None, name)
    ]
    if len(cameras) != 1:
        return None
    number, entry, name = cameras[0]
    try:
        place = place_of(run, entry)
    except RunError as error:
        raise UnreadableRunError(f"{error}; --without-images leaves its pictures out") from None
    with open_log(place, run.limits) as log:
        topic = next(one for one in log.topics if one.name == name)
    part = manifest.selection
    selection = Selection(frozenset({topic.name}), part.start_ns, part.end_ns)
    clock = manifest.timeline.clock(number)
    return StoredCamera(place, topic, _clock(detected, topic.name), selection, clock, run.limits)


def _clock(detected: DetectManifest | None, topic: str) -> Clock:
    for rows in () if detected is None else detected.clocks:
        if topic in rows:
            return rows[topic].used
    return Clock.LOG


def picture_at(camera: StoredCamera, t_ns: int) -> Encoded | None:
    """The picture taken at exactly this time of the run's tables; None where none exists.

    Raises:
        LogError: The log cannot be opened.
    """
    found: list[Encoded] = []
    pictures_at(camera, (t_ns,), lambda _, picture: found.append(picture))
    return found[0] if found else None


def pictures_at(
    camera: StoredCamera, times: Collection[int], on_picture: Callable[[int, Encoded], None]
) -> None:
    """Give the pictures taken at exactly these times of the run's tables to ``on_picture``.

    Raises:
        LogError: The log cannot be opened.
    """
    wanted = np.array(sorted(times), np.int64)

    def keep(block: Block) -> None:
        assert isinstance(block.rows, Images)
        for i in np.flatnonzero(np.isin(block.log_ns, wanted)).tolist():
            on_picture(int(block.log_ns[i]), encoded(block.rows, i))

    if len(wanted):
        read_pictures(camera, keep, (int(wanted[0]), int(wanted[-1])))


def read_pictures(
    camera: StoredCamera,
    on_pictures: Callable[[Block], None],
    span_ns: tuple[int, int] | None = None,
) -> None:
    """Give every block of pictures to ``on_pictures``, and warn of what was dropped.

    Args:
        camera: Where they are.
        on_pictures: Called with blocks of ``Images`` with times as in the run's tables.
        span_ns: Those of this time, and some before and behind it; None for all.

    Raises:
        LogError: The log cannot be opened.
    """
    ledger = Ledger(str(camera.log))
    extractor = Extractor(
        Plan((Source(0, camera.topic, ()),), {}),
        Vehicle(version=1),
        0,
        ledger,
        {camera.topic.name: camera.clock},
        on_pictures=on_pictures,
        shift_at=camera.time.shift_at if len(camera.time.epochs) > 1 else None,
    )
    selection = camera.selection
    # Rows are told apart by counting where stamps alone do not do.
    if span_ns is not None and camera.topic.name not in camera.time.topics:
        begin, end = span_ns[0] - AROUND_NS, span_ns[1] + AROUND_NS
        selection = Selection(selection.topics, begin, end)
    with open_log(camera.log, camera.limits) as log:
        for block in TimedLog(log, camera.time).read(ledger, selection):
            for _ in extractor(block):
                pass
    warn_of(ledger)
