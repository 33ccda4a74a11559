"""Recording of camera pictures: JPEG and PNG are passed through, others converted to JPEG."""

from dataclasses import dataclass, field
from typing import Final

import cv2
import rerun as rr

from crosscue.detectors.images import Encoded, check, decode
from crosscue.eval.runs.stored_images import StoredCamera, read_pictures
from crosscue.replay.errors import LogFormatError

from .columns import DriveTime
from .part import RecordingSpan

# Encodings that the viewer decodes itself.
PASSED_THROUGH: Final = ("jpeg", "png")
ENTITY: Final = "camera/picture"
BATCH_BYTES: Final = 4 << 20
QUALITY: Final = 90


def send_pictures(
    recording: rr.RecordingStream, time: DriveTime, camera: StoredCamera, part: RecordingSpan
) -> int:
    """Send all usable pictures of a part; return the number of others.

    Raises:
        LogError: The log cannot be opened.
    """
    sink = _Sink(recording, time, part)
    span_ns = None if part.is_whole else (part.start_ns, part.end_ns)
    lost = read_pictures(camera, sink.add, span_ns)
    sink.send()
    return lost


@dataclass(slots=True)
class _Sink:
    recording: rr.RecordingStream
    time: DriveTime
    part: RecordingSpan
    held: list[tuple[int, bytes, str]] = field(default_factory=list)
    size_bytes: int = 0

    def add(self, t_ns: int, picture: Encoded) -> None:
        """Send a picture of the part together with others, a few megabytes at a time."""
        if not self.part.start_ns <= t_ns <= self.part.end_ns:
            return
        is_stored = picture.coding in PASSED_THROUGH
        if is_stored:
            check(picture)
        content = bytes(picture.content) if is_stored else shown(picture)
        self.held.append((t_ns, content, f"image/{picture.coding if is_stored else 'jpeg'}"))
        self.size_bytes += len(content)
        if self.size_bytes > BATCH_BYTES:
            self.send()

    def send(self) -> None:
        """Send the pictures held."""
        held, self.held, self.size_bytes = self.held, [], 0
        if not held:
            return
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


def shown(picture: Encoded) -> bytes:
    """Return a picture as JPEG.

    Raises:
        LogFormatError: The picture is damaged, truncated or of an unsupported coding.
        LogTooLargeError: The picture exceeds the maximum number of pixels.
    """
    ok, jpeg = cv2.imencode(".jpg", decode(picture)[0], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not ok:
        raise LogFormatError(f"{picture.coding} picture cannot be shown as JPEG")
    return jpeg.tobytes()
