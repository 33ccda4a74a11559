"""Recording of camera pictures: JPEG and PNG are passed through, others converted to JPEG."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import rerun as rr

from crosscue.detectors.images import Encoded, decode, encoded
from crosscue.replay.base import Block, Images, LogError

from .columns import DriveTime

PASSED_THROUGH: Final = ("jpeg", "png")
"""Encodings that the viewer decodes itself."""
ENTITY: Final = "camera/picture"
BATCH_BYTES: Final = 4 << 20
QUALITY: Final = 90


def log_pictures(
    recording: rr.RecordingStream,
    read_pictures: Callable[[Callable[[Block], None]], None],
    time: DriveTime,
) -> int:
    """Send all pictures that can be decoded; return the number of others.

    Raises:
        LogError: The log cannot be opened.
    """
    sink = _Sink(recording, time)
    read_pictures(sink.add)
    return sink.left_out


@dataclass(slots=True)
class _Sink:
    recording: rr.RecordingStream
    time: DriveTime
    left_out: int = 0

    def add(self, block: Block) -> None:
        """Send a block's pictures, a few megabytes at a time."""
        images = block.rows
        assert isinstance(images, Images)
        held: list[tuple[int, bytes, str]] = []
        size = 0
        for i, coding in enumerate(images.coding):
            is_stored = coding in PASSED_THROUGH
            content = bytes(images.bytes_.payload(i)) if is_stored else shown(encoded(images, i))
            if content is None:
                self.left_out += 1
                continue
            kind = f"image/{coding}" if is_stored else "image/jpeg"
            held.append((int(block.log_ns[i]), content, kind))
            size += len(content)
            if size > BATCH_BYTES:
                self._send(held)
                held, size = [], 0
        if held:
            self._send(held)

    def _send(self, held: list[tuple[int, bytes, str]]) -> None:
        self.recording.send_columns(
            ENTITY,
            indexes=self.time.column([t_ns for t_ns, _, _ in held]),
            columns=rr.EncodedImage.columns(
                blob=[content for _, content, _ in held],
                media_type=[kind for _, _, kind in held],
            ),
        )
        # Without flushing, pictures arrive faster than the disk writes them, and memory grows.
        self.recording.flush()


def shown(picture: Encoded) -> bytes | None:
    """Return a picture as JPEG, or None if it cannot be decoded."""
    import cv2

    try:
        pixels, _ = decode(picture)
    except LogError:
        return None
    ok, jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return jpeg.tobytes() if ok else None
