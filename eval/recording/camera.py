"""The camera's pictures, their bytes passed through as the log stores them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import rerun as rr

from crosscue.eval.stored_pictures import StoredCamera, read_pictures
from crosscue.replay.columns import Block, Images

from .drive_time import DriveTime

PASSED_THROUGH: Final = ("jpeg", "png")
"""Codings that the viewer decodes itself."""
ENTITY: Final = "camera/picture"
BATCH_BYTES: Final = 4 << 20


def log_pictures(recording: rr.RecordingStream, camera: StoredCamera, time: DriveTime) -> int:
    """Send all pictures; returns how many the viewer could not show, which are left out.

    Raises:
        LogError: The log cannot be opened.
    """
    sink = _Sink(recording, time)
    read_pictures(camera, sink.add)
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
