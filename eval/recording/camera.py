"""The camera's pictures, their bytes passed through as the log stores them."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import rerun as rr

from crosscue.replay.clocks import Clock
from crosscue.replay.columns import Block, Images, Topic
from crosscue.replay.errors import LogError
from crosscue.replay.ledger import Ledger
from crosscue.replay.log import Selection, open_log
from crosscue.replay.roles import Role, role_of
from crosscue.replay.run_folder import RunFolder
from crosscue.replay.signals import Extractor, Plan, Source
from crosscue.replay.vehicle import Vehicle

from .drive_time import DriveTime

PASSED_THROUGH: Final = ("jpeg", "png")
"""Codings that the viewer decodes itself."""
ENTITY: Final = "camera/picture"
BATCH_BYTES: Final = 4 << 20


@dataclass(frozen=True, slots=True)
class StoredCamera:
    """Where a run's pictures lie.

    Attributes:
        log: Path.
        topic: In it.
        clock: Whose times the run's tables have.
        selection: What part of the log the run looked at.
    """

    log: Path
    topic: Topic
    clock: Clock
    selection: Selection


def camera_of(run: RunFolder) -> StoredCamera | None:
    """The camera, where its log is still at hand and no choice is left."""
    manifest = run.manifest()
    detected = manifest if manifest.get("stage") == "detect" else manifest.get("detect")
    named = manifest["settings"]["topics"]["camera"] if detected is None else detected["camera"]
    found: list[tuple[Path, Topic]] = []
    for entry in manifest["logs"]:
        path = Path(entry["path"])
        # The log may have gone since it was replayed; the rest of the run can still be seen.
        with suppress(LogError), open_log(path) as log:
            found += [(path, topic) for topic in log.topics if role_of(topic) is Role.CAMERA]
    if named is not None:
        found = [(path, topic) for path, topic in found if topic.name == named]
    if len(found) != 1:
        return None
    path, topic = found[0]
    part = manifest["selection"]
    selection = Selection(frozenset({topic.name}), part["start_ns"], part["end_ns"])
    return StoredCamera(path, topic, _clock(detected, topic.name), selection)


def _clock(detected: Mapping[str, Any] | None, topic: str) -> Clock:
    for told in [] if detected is None else detected["clocks"]:
        if topic in told:
            return Clock(told[topic]["used"])
    return Clock.LOG


def log_pictures(recording: rr.RecordingStream, camera: StoredCamera, time: DriveTime) -> int:
    """Send all pictures; returns how many the viewer could not show, which are left out."""
    source = Source(0, camera.topic, ())
    sink = _Sink(recording, time)
    ledger = Ledger(str(camera.log))
    extractor = Extractor(
        Plan((source,), {}), Vehicle(version=1), 0, ledger, {camera.topic.name: camera.clock},
        on_pictures=sink.add,
    )  # fmt: skip
    with open_log(camera.log) as log:
        for block in log.read(ledger, camera.selection):
            for _ in extractor(block):
                pass
    return sink.left_out


@dataclass(slots=True)
class _Sink:
    recording: rr.RecordingStream
    time: DriveTime
    left_out: int = 0

    def add(self, block: Block) -> None:
        """Send a block's pictures some megabytes at a time."""
        images = block.rows
        assert isinstance(images, Images)
        rows = [i for i, coding in enumerate(images.coding) if coding in PASSED_THROUGH]
        self.left_out += len(images) - len(rows)
        held: list[int] = []
        size = 0
        for i in rows:
            held.append(i)
            size += len(images.bytes_.payload(i))
            if size > BATCH_BYTES:
                self._send(block, images, held)
                held, size = [], 0
        if held:
            self._send(block, images, held)

    def _send(self, block: Block, images: Images, rows: list[int]) -> None:
        self.recording.send_columns(
            ENTITY,
            indexes=self.time.column(block.log_ns[rows]),
            columns=rr.EncodedImage.columns(
                blob=[bytes(images.bytes_.payload(i)) for i in rows],
                media_type=[f"image/{images.coding[i]}" for i in rows],
            ),
        )
