"""Decode packets of a video stream (H.264, H.265, AV1) into pictures with FFmpeg (PyAV).

The row of a packet has the time of its picture. Pictures are therefore yielded with their own times
in display order, whatever the order of coding.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

from crosscue.replay.columns import Block, Images, raw_block
from crosscue.replay.errors import one_line
from crosscue.replay.ledger import Ledger
from crosscue.replay.readers.can_rows import keep_memory

if TYPE_CHECKING:
    from av import VideoFrame

# FFmpeg's decoders by coding of ``Images``.
CODECS: Final = {"h264": "h264", "h265": "hevc", "av1": "libdav1d"}
MAX_PIXELS: Final = 64_000_000
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
        keep_memory()
        self._topic = topic
        self._ledger = ledger
        self._context: Any = None
        self._converter: Any = None
        self._waiting: list[VideoFrame] = []
        self._taken = self._shown = 0

    def __call__(self, block: Block) -> Iterator[Block]:
        """Yield the pictures completed by these packets; some may only follow later packets."""
        assert isinstance(block.rows, Images)
        import av
        from av.video.reformatter import VideoReformatter

        for i, t_ns in enumerate(block.log_ns.tolist()):
            if self._context is None:
                self._context = _context(block.rows.coding[i])
                # One for all pictures: preparing a conversion takes an eighth of its time.
                self._converter = VideoReformatter()
            packet = av.Packet(bytes(block.rows.bytes_.payload(i)))
            packet.pts = t_ns
            try:
                self._waiting += self._context.decode(packet)
                self._taken += 1
            except av.FFmpegError as error:
                why = one_line(error, 100)
                self._ledger.spoil(self._topic, NOT_DECODED, 1, why, t_ns)
            yield from self._blocks()

    def flush(self) -> Iterator[Block]:
        """Yield the last pictures, and report packets that yielded none."""
        if self._context is None:
            return
        import av

        try:
            self._waiting += self._context.decode(None)
        except av.FFmpegError as error:
            self._ledger.notice(f"{self._topic}: the video's end does not decode: {error}")
        yield from self._blocks()
        lacking = self._taken - self._shown
        if lacking > 0:
            # A stream that does not begin at a key frame loses the packets before the first one.
            self._ledger.skip(self._topic, NO_PICTURE, lacking)
        self._context = None

    def _blocks(self) -> Iterator[Block]:
        """Yield each picture as a block, so that its pixels are not copied."""
        frames, self._waiting = self._waiting, []
        for frame in frames:
            assert frame.pts is not None
            self._shown += 1
            converted = self._converter.reformat(frame, format="bgr24")
            yield raw_block(self._topic, frame.pts, converted.to_ndarray(), "bgr8")


def _context(coding: str) -> Any:
    import av

    context: Any = av.CodecContext.create(CODECS[coding], "r")
    context.options = {"max_pixels": str(MAX_PIXELS)}
    context.thread_count = 1
    return context
