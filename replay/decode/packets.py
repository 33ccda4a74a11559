"""Decode packets of a video stream (H.264, H.265, AV1) into pictures with FFmpeg (PyAV).

The row of a packet has the time of its picture. Pictures are therefore yielded with their own times
in display order, whatever the order of coding.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from crosscue.replay.columns import Block, Images, Messages
from crosscue.replay.errors import one_line
from crosscue.replay.ledger import Ledger

if TYPE_CHECKING:
    from av import VideoFrame

# FFmpeg's decoders by coding of ``Images``.
CODECS: Final = {"h264": "h264", "h265": "hevc", "av1": "libdav1d"}
MAX_PIXELS: Final = 64_000_000
# Number of pictures in a block; at 1280 by 720 these are 22 MB.
AT_ONCE: Final = 8
NOT_DECODED: Final = "video packet not decoded"
NO_PICTURE: Final = "video packet without picture"


def is_stream(images: Images) -> bool:
    """Return whether these are packets of a video stream, not complete pictures."""
    return any(coding in CODECS for coding in images.coding)


class PacketDecoder:
    """Decoder of one topic's packets into raw pictures (``bgr8``); call ``flush`` at the end."""

    def __init__(self, topic: str, ledger: Ledger) -> None:
        """Prepare the decoder.

        Args:
            topic: Topic of the packets.
            ledger: Records packets that yield no picture.
        """
        self._topic = topic
        self._ledger = ledger
        self._context: Any = None
        self._waiting: list[VideoFrame] = []
        self._taken = self._shown = 0

    def __call__(self, block: Block) -> Iterator[Block]:
        """Yield the pictures completed by these packets; some may only follow later packets."""
        assert isinstance(block.rows, Images)
        import av

        for i, t_ns in enumerate(block.log_ns.tolist()):
            if self._context is None:
                self._context = _context(block.rows.coding[i])
            packet = av.Packet(bytes(block.rows.bytes_.payload(i)))
            packet.pts = t_ns
            try:
                self._waiting += self._context.decode(packet)
                self._taken += 1
            except av.FFmpegError as error:
                why = one_line(error, 100)
                self._ledger.spoil(self._topic, NOT_DECODED, 1, why, t_ns)
            yield from self._full()

    def flush(self) -> Iterator[Block]:
        """Yield the last pictures, and report packets that yielded none."""
        if self._context is None:
            return
        import av

        try:
            self._waiting += self._context.decode(None)
        except av.FFmpegError as error:
            self._ledger.notice(f"{self._topic}: the video's end does not decode: {error}")
        while self._waiting:
            yield self._block()
        lacking = self._taken - self._shown
        if lacking > 0:
            # A stream that does not begin at a key frame loses the packets before the first one.
            self._ledger.skip(self._topic, NO_PICTURE, lacking)
        self._context = None

    def _full(self) -> Iterator[Block]:
        while len(self._waiting) >= AT_ONCE:
            yield self._block()

    def _block(self) -> Block:
        frames, self._waiting = self._waiting[:AT_ONCE], self._waiting[AT_ONCE:]
        self._shown += len(frames)
        pixels = [frame.to_ndarray(format="bgr24") for frame in frames]
        stop = np.cumsum([picture.size for picture in pixels], dtype=np.int64)
        start = np.concatenate([[0], stop[:-1]]).astype(np.int64)
        buffer = np.concatenate([np.asarray(picture, np.uint8).ravel() for picture in pixels])
        sizes = np.array([picture.shape[:2] for picture in pixels], np.int32)
        images = Images(
            Messages(buffer, start, stop),
            ("raw",) * len(frames),
            sizes[:, 1],
            sizes[:, 0],
            3 * sizes[:, 1],
            ("bgr8",) * len(frames),
        )
        return Block(self._topic, np.array([frame.pts for frame in frames], np.int64), images)


def _context(coding: str) -> Any:
    import av

    context: Any = av.CodecContext.create(CODECS[coding], "r")
    context.options = {"max_pixels": str(MAX_PIXELS)}
    context.thread_count = 1
    return context
