"""Pictures of a run, read again from its log, on the clock of the run's tables."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.detectors.images import Encoded, encoded, lose
from crosscue.eval.runs.folder import RunFolder
from crosscue.replay.base import Selection
from crosscue.replay.clocks.clock import Clock
from crosscue.replay.columns import Block, Images, Topic
from crosscue.replay.errors import LogError, RunError, UnreadableRunError
from crosscue.replay.ledger import Ledger, warn_of
from crosscue.replay.limits import DEFAULT_LIMITS, Limits
from crosscue.replay.logs.opening import open_log
from crosscue.replay.signals.extractor import SampleExtractor
from crosscue.replay.signals.kinds import SignalPlan, SignalSource
from crosscue.replay.time.segments import UNSHIFTED, LogClock, TimedLog
from crosscue.replay.vehicle.vehicle import Vehicle

from .logs import log_location
from .manifest import DetectManifest

# Max difference between a picture's own clock and the log's.
AROUND_NS: Final = 2_000_000_000


@dataclass(frozen=True, slots=True)
class StoredCamera:
    """Source of a run's pictures.

    Attributes:
        log: Path or URL of the log.
        topic: Topic of the camera.
        clock: Clock of the run's tables.
        selection: The part of the log that the run examined.
        time: The log's clock relative to the times of the run's tables.
        limits: Limits for reading the log.
    """

    log: Path | str
    topic: Topic
    clock: Clock
    selection: Selection
    time: LogClock = UNSHIFTED
    limits: Limits = DEFAULT_LIMITS


def run_camera(run: RunFolder) -> StoredCamera | None:
    """Return the camera of a run; None if its logs have none, or several without a choice.

    Raises:
        RunError: The manifest cannot be read, or the log is missing or has changed.
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
        place = log_location(run, entry)
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
    """Return the picture with exactly this time in the run's tables, or None.

    Raises:
        LogError: The log cannot be opened.
    """
    found: list[Encoded] = []
    pictures_at(camera, (t_ns,), lambda _, picture: found.append(picture))
    return found[0] if found else None


def pictures_at(
    camera: StoredCamera, times: Collection[int], on_picture: Callable[[int, Encoded], None]
) -> None:
    """Pass the pictures with exactly these times in the run's tables to ``on_picture``.

    As in ``read_pictures``, it raises an error for a picture that cannot be used.

    Raises:
        LogError: The log cannot be opened.
    """
    wanted = frozenset(times)

    def keep(t_ns: int, picture: Encoded) -> None:
        if t_ns in wanted:
            on_picture(t_ns, picture)

    if wanted:
        read_pictures(camera, keep, (min(wanted), max(wanted)))


def read_pictures(
    camera: StoredCamera,
    on_picture: Callable[[int, Encoded], None],
    span_ns: tuple[int, int] | None = None,
) -> int:
    """Pass every picture to ``on_picture``, and warn about dropped rows.

    Args:
        camera: Source of the pictures.
        on_picture: Called with the time, as in the run's tables, and the picture. If it raises a
            ``LogError``, the picture is dropped.
        span_ns: Time span to read, with some pictures before and after it; None for all.

    Returns:
        The number of pictures that ``on_picture`` could not use.

    Raises:
        LogError: The log cannot be opened.
    """
    ledger, lost = Ledger(str(camera.log)), 0

    def on_pictures(block: Block) -> None:
        nonlocal lost
        assert isinstance(block.rows, Images)
        for row, t_ns in enumerate(block.log_ns.tolist()):
            try:
                on_picture(t_ns, encoded(block.rows, row))
            except LogError as error:
                log_ns = int(camera.time.log_times(np.array([t_ns]))[0])
                lose(ledger, block.topic, log_ns, error)
                lost += 1

    extractor = SampleExtractor(
        SignalPlan((SignalSource(0, camera.topic, ()),), {}),
        Vehicle(version=1),
        0,
        ledger,
        {camera.topic.name: camera.clock},
        on_pictures=on_pictures,
        shift_at=camera.time.shift_at if len(camera.time.epochs) > 1 else None,
    )
    selection = camera.selection
    # Rows whose stamps are ambiguous are identified by counting.
    if span_ns is not None and camera.topic.name not in camera.time.topics:
        begin, end = span_ns[0] - AROUND_NS, span_ns[1] + AROUND_NS
        selection = Selection(selection.topics, begin, end)
    with open_log(camera.log, camera.limits) as log:
        for block in TimedLog(log, camera.time).read(ledger, selection):
            for _ in extractor(block):
                pass
    warn_of(ledger)
    return lost
