"""Reader of video files: the packets of one camera, with times from a time file.

A row is one packet of the first video stream, in stored order (which is decoding order): H.264 and
H.265 in Annex B form with parameter sets before key frames, AV1 as stored, Motion JPEG as images.
The reader decodes other codecs into ``raw`` images (``rgb8``). A row's time is the time of the
image that the packet decodes to, so the times of packets are not monotonic where images are coded
out of order. A decoder can only start at a key frame, so select a slightly longer time range than
needed.

Times are read from the time file next to the video (``time_file``), with one line per image in
presentation order. Without a time file, the container's presentation times are used, which start at
0. A raw ``.h264`` or ``.hevc`` stream has no times and needs the time file.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, cast

import numpy as np

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import Block, Int64s, Topic, raw_block
from crosscue.replay.errors import LogFormatError
from crosscue.replay.files.closing import Closing
from crosscue.replay.files.time_file_names import time_file_of_video
from crosscue.replay.ledger import NOT_ASKED_TIME, Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.readers.time_file import SECOND_NS, TimeFile, read_time_file

from .files import PictureBatch

if TYPE_CHECKING:
    from av import Packet, VideoFrame, VideoStream
    from av.bitstream import BitStreamFilterContext
    from av.container import InputContainer

# FFmpeg's demuxers by suffix; none is probed, because some demuxers open other files.
DEMUXERS: Final = {
    ".mp4": "mov",
    ".mov": "mov",
    ".avi": "avi",
    ".mkv": "matroska",
    ".ts": "mpegts",
    ".hevc": "hevc",
    ".h264": "h264",
}
WITHOUT_TIMES: Final = frozenset({".hevc", ".h264"})
CODINGS: Final = {"h264": "h264", "hevc": "h265", "av1": "av1", "mjpeg": "jpeg", "png": "png"}
TO_ANNEX_B: Final = {"h264": "h264_mp4toannexb", "hevc": "hevc_mp4toannexb"}
NO_TIME: Final = -1


@dataclass(frozen=True, slots=True, eq=False)
class _Index:
    """Results of a first pass over the packets.

    Attributes:
        t_ns: Shape (N,), int64: time of each packet's image, or ``NO_TIME``.
        is_damaged: N flags.
        stopped: Reason why the pass ended before the file's end, or empty.
        notices: Remarks on the times, one sentence each.
        missing: Number of lines of the time file without a packet.
    """

    t_ns: Int64s
    is_damaged: tuple[bool, ...]
    stopped: str
    notices: tuple[str, ...]
    missing: int


class Video(Closing):
    """A video file as a ``Log``."""

    format: Final = "video"

    def __init__(self, path: Path, file: BinaryIO, times: TimeFile | None, limits: Limits) -> None:
        """Read the header.

        Raises:
            LogFormatError: The file is truncated or damaged, or has no video stream.
        """
        self.path: Final = path
        self._file: Final = file
        self._times: Final = times
        self._limits: Final = limits
        with self._container() as container:
            stream = _video_stream(container, path)
            self._codec: Final = stream.codec_context.name
            declared = stream.frames or None
            self._duration_s: Final = _duration_s(container)
            self._streams: Final = len(container.streams.video)
            self._has_reordering: Final = bool(stream.codec_context.has_b_frames)
            try:
                _annex_b(stream)
            except _failures() as error:
                raise LogFormatError(
                    f"{path}: the stream's parameter sets are damaged ({_words(error)}); no "
                    "picture can be decoded; copy it again from the recorder"
                ) from None
        if declared is None and times is not None and times.period is None:
            declared = len(times.t_ns)
        self.topics: Final = (Topic(path.stem, "crosscue/Images", "columns", declared=declared),)

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Yield the packets in stored order; see ``Log.read`` and the module's docstring."""
        (topic,) = self.topics
        ledger.integrity = "video packets carry no checksum: a changed picture cannot be detected"
        if self.path.suffix.lower() in WITHOUT_TIMES:
            ledger.integrity += ", nor a missing end except by the time file's lines"
        ledger.declare(topic.name, topic.declared)
        index = self._index()
        if not selection.wants(topic.name):
            selection.leave(topic.name, len(index.t_ns), ledger)
        else:
            for sentence in index.notices:
                ledger.notice(sentence)
            wanted = (index.t_ns != NO_TIME) & selection.inside(index.t_ns)
            if self._codec in CODINGS:
                yield from self._packets(index, wanted.tolist(), ledger)
            else:
                yield from self._decoded(index, wanted.tolist(), ledger)
        ledger.drop(topic.name, "a time without its picture", index.missing)
        self._settle(index, ledger)

    def report_missing(self, ledger: Ledger) -> None:
        """Report different counts of the container and the time file; see ``KnowsItsEnd``."""
        (topic,) = self.topics
        if self._times is None or self._times.period is not None or topic.declared is None:
            return
        for sentence in self._times.notices:
            ledger.notice(sentence)
        surplus = topic.declared - len(self._times.t_ns)
        ledger.drop(topic.name, "a picture without its time", max(surplus, 0))
        ledger.drop(topic.name, "a time without its picture", max(-surplus, 0))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _container(self) -> InputContainer:
        import av

        self._file.seek(0)
        try:
            return av.open(self._file, mode="r", format=DEMUXERS[self.path.suffix.lower()])
        except _failures() as error:
            raise LogFormatError(
                f"{self.path}: cut or damaged, no video can be found in it "
                f"({_words(error)}); copy it again from the recorder"
            ) from None

    def _index(self) -> _Index:
        """Examine all packets once for their number, times and damage."""
        pts: list[int | None] = []
        is_damaged: list[bool] = []
        stopped = ""
        with self._container() as container:
            stream = _video_stream(container, self.path)
            base = stream.time_base
            try:
                for packet in container.demux(stream):
                    if packet.size:
                        pts.append(packet.pts)
                        is_damaged.append(packet.is_corrupt)
            except _failures() as error:
                stopped = _words(error)
        unit_ns = SECOND_NS * base if base else None
        notices = []
        if self._streams > 1:
            notices.append(f"{self._streams} video streams; only the first is read")
        if self._times is None:
            notices.append("times are the video's own, starting at 0: they share no clock with CAN")
            known = [p for p in pts if p is not None]
            first = min(known, default=0)
            own = [
                NO_TIME if p is None or unit_ns is None else round((p - first) * unit_ns)
                for p in pts
            ]
            t_ns = np.array(own, dtype=np.int64)
            self._shown_order(pts, notices)
            return _Index(t_ns, tuple(is_damaged), stopped, tuple(notices), 0)
        notices += self._times.notices
        shown = self._shown_order(pts, notices)
        lines = len(self._times.t_ns) if self._times.period is None else len(pts)
        if self._times.period is not None:
            rate_hz = float(SECOND_NS / self._times.period)
            notices.append(f"times are computed from a constant rate of {rate_hz:g} Hz, from 0 on")
        elif lines != len(pts):
            notices.append(
                f"{len(pts)} pictures and {lines} times ({self._times.path.name}): paired in order "
                "from the first"
            )
        t_ns = np.full(len(pts), NO_TIME, dtype=np.int64)
        timed = shown < lines
        t_ns[timed] = self._times.times_at(shown[timed])
        missing = max(lines - len(pts), 0)
        return _Index(t_ns, tuple(is_damaged), stopped, tuple(notices), missing)

    def _shown_order(self, pts: list[int | None], notices: list[str]) -> Int64s:
        """Return each packet's index in presentation order."""
        stored = np.arange(len(pts), dtype=np.int64)
        if self.path.suffix.lower() == ".avi" and not self._has_reordering:
            # AVI has no presentation times. The demuxer only guesses them, and damaged images
            # mislead it.
            return stored
        known = [p for p in pts if p is not None]
        if len(known) == len(pts):
            shown = np.empty(len(pts), dtype=np.int64)
            shown[np.argsort(np.array(known, dtype=np.int64), kind="stable")] = np.arange(len(pts))
            if (np.diff(shown) < 0).any():
                notices.append("pictures are not stored in presentation order")
            return shown
        if self._has_reordering:
            notices.append(
                "the stream does not state the presentation order of pictures, which may differ "
                "from the stored order; times follow the stored order"
            )
        return stored

    def _packets(self, index: _Index, wanted: list[bool], ledger: Ledger) -> Iterator[Block]:
        """Yield blocks of packets as stored."""
        name, coding = self.topics[0].name, CODINGS[self._codec]
        batch = PictureBatch(name)
        with self._container() as container:
            stream = _video_stream(container, self.path)
            convert = _annex_b(stream)
            packets = (packet for packet in _demuxed(container, stream) if packet.size)
            for i, packet in enumerate(packets):
                if i >= len(wanted) or not self._usable(index, i, packet.size, wanted[i], ledger):
                    continue
                try:
                    payload = b"".join(map(bytes, convert.filter(packet) if convert else [packet]))
                except _failures() as error:
                    ledger.drop(name, "packet damaged", 1, _words(error), int(index.t_ns[i]))
                    continue
                ledger.find(name, 1)
                yield from batch.add(int(index.t_ns[i]), payload, coding)
        yield from batch.flush()

    def _usable(self, index: _Index, i: int, size: int, wanted: bool, ledger: Ledger) -> bool:
        """Account for a packet, and return whether it is yielded."""
        name, t_ns = self.topics[0].name, int(index.t_ns[i])
        if index.is_damaged[i]:
            ledger.drop(name, "packet damaged", 1, f"packet {i}", t_ns)
            return False
        if t_ns == NO_TIME:
            ledger.drop(name, "a picture without its time", 1, f"packet {i}: {size} bytes")
            return False
        reason = None
        if not wanted:
            reason = NOT_ASKED_TIME
        elif size > self._limits.message_bytes:
            reason = "picture over the size limit"
        if reason is not None:
            ledger.find(name, 1)
            ledger.skip(name, reason, 1, f"packet {i}: {size} bytes", t_ns)
        return reason is None

    def _decoded(self, index: _Index, wanted: list[bool], ledger: Ledger) -> Iterator[Block]:
        """Yield blocks of one decoded image, for codecs that other modules do not support."""
        name = self.topics[0].name
        ledger.notice(f"codec {self._codec}: decoded by the reader")
        shown = set[int]()
        with self._container() as container:
            for i, frame in self._frames(container, len(wanted)):
                shown.add(i)
                size = frame.width * frame.height * 3
                if self._usable(index, i, size, wanted[i], ledger):
                    ledger.find(name, 1)
                    pixels = frame.to_ndarray(format="rgb24")
                    yield raw_block(name, int(index.t_ns[i]), pixels, "rgb8")
        for i in sorted(set(range(len(wanted))) - shown):
            t_ns = int(index.t_ns[i])
            at_ns = None if t_ns == NO_TIME else t_ns
            ledger.drop(name, "picture cannot be decoded", 1, f"packet {i}", at_ns)

    def _frames(self, container: InputContainer, packets: int) -> Iterator[tuple[int, VideoFrame]]:
        """Yield the decodable images with the indices of their packets.

        The indices preserve the times of the images around an undecodable image.
        """
        from av.codec.context import Flags

        stream = _video_stream(container, self.path)
        stream.codec_context.flags |= Flags.copy_opaque
        number = 0
        for packet in _demuxed(container, stream):
            packet.opaque = number
            number += packet.size > 0
            try:
                frames = packet.decode()
            except _failures():
                continue
            for frame in frames:
                source = frame.opaque
                if isinstance(source, int) and source < packets:
                    yield source, frame

    def _settle(self, index: _Index, ledger: Ledger) -> None:
        (topic,) = self.topics
        if index.stopped:
            ledger.drop(topic.name, "file is cut or damaged", None, index.stopped)
        elif topic.declared is None and self._times is None and self._duration_s is not None:
            last_s = float(index.t_ns.max(initial=0)) / SECOND_NS
            period_s = last_s / max(len(index.t_ns) - 1, 1)
            # A complete file ends one period after its last image's time.
            if self._duration_s - last_s > 1.6 * period_s:
                detail = (
                    f"the container has {self._duration_s:.2f} s, packets end at {last_s:.2f} s"
                )
                ledger.drop(topic.name, "file is cut or damaged", None, detail)
        ledger.settle(topic.name, "declared by the container, not in its bytes")


def open_video(path: Path, limits: Limits) -> Video:
    """Open a video file; see ``crosscue.replay.formats.FORMATS``.

    Raises:
        LogFormatError: It is truncated or damaged, has no video, or has no times.
    """
    time_file = time_file_of_video(path)
    times = None if time_file is None else read_time_file(time_file, limits)
    if times is None and path.suffix.lower() in WITHOUT_TIMES:
        raise LogFormatError(
            f"{path}: a raw stream has no times; write {path.name}.txt with one time for each "
            "picture (seconds with a decimal point), or the line 'rate_hz: 20'"
        )
    if times is not None and times.names is not None:
        raise LogFormatError(
            f"{times.path}: names files; expected one time for each picture of {path.name}"
        )
    file = path.open("rb")
    try:
        return Video(path, file, times, limits)
    except BaseException:
        file.close()
        raise


def _video_stream(container: InputContainer, path: Path) -> VideoStream:
    for stream in container.streams.video:
        # None if FFmpeg has no decoder, contrary to the type annotation.
        if cast("object", stream.codec_context) is not None:
            return stream
    raise LogFormatError(
        f"{path}: no video stream of a known codec in it; give the camera's file, undamaged"
    )


def _duration_s(container: InputContainer) -> float | None:
    """Return the duration that the container states, if it applies to the video stream."""
    import av

    if container.duration is None or len(container.streams) != 1:
        return None
    return container.duration / av.time_base


def _demuxed(container: InputContainer, stream: VideoStream) -> Iterator[Packet[VideoStream]]:
    """Yield packets until the end or the first damage, which the first pass has reported."""
    try:
        yield from container.demux(stream)
    except _failures():
        return


def _annex_b(stream: VideoStream) -> BitStreamFilterContext | None:
    """Return a filter to Annex B if the stream is stored with lengths (``avcC``, ``hvcC``)."""
    from av.bitstream import BitStreamFilterContext

    extra = stream.codec_context.extradata
    name = TO_ANNEX_B.get(stream.codec_context.name)
    if name is None or not extra or extra[0] != 1:
        return None
    return BitStreamFilterContext(name, stream)


def _failures() -> tuple[type[Exception], ...]:
    """Return the exceptions that PyAV raises for damaged input; ``OSError`` for an empty file."""
    import av

    return av.FFmpegError, ValueError, OSError


def _words(error: BaseException) -> str:
    """Return FFmpeg's message without its error number and the file object."""
    text = getattr(error, "strerror", None) or str(error)
    return str(text).replace("\n", " ")[:200]
