"""Small simulated videos whose pictures encode their number as a grey level."""

from fractions import Fraction
from pathlib import Path
from typing import cast

import av
import numpy as np

from crosscue.replay.columns import Block, Images

# Grey levels between consecutive pictures; encoding errors are less than half of it.
STEP = 9
SIZE_PX = (64, 48)


def video(
    path: Path,
    count: int = 24,
    codec: str = "libx264",
    options: dict[str, str] | None = None,
    container: dict[str, str] | None = None,
    file_format: str | None = None,
) -> Path:
    """Write a video of ``count`` uniform pictures at 20 Hz."""
    with av.open(str(path), mode="w", options=container or {}, format=file_format) as out:
        stream = cast("av.VideoStream", out.add_stream(codec, rate=20, options=options or {}))
        stream.width, stream.height = SIZE_PX
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.time_base = Fraction(1, 20)
        for number in range(count):
            grey = np.full((SIZE_PX[1], SIZE_PX[0], 3), 10 + STEP * number, dtype=np.uint8)
            frame = av.VideoFrame.from_ndarray(grey, format="rgb24")
            frame.pts = number
            frame.time_base = Fraction(1, 20)
            for packet in stream.encode(frame):
                out.mux(packet)
        for packet in stream.encode(None):
            out.mux(packet)
    return path


def numbers_at_times(blocks: list[Block], codec: str) -> dict[int, int]:
    """Decode blocks of packets, and return the number of the picture at each time."""
    decoder = av.CodecContext.create(codec, "r")
    shown: dict[int, int] = {}
    packets: list[av.Packet | None] = []  # type: ignore[type-arg]
    for block in blocks:
        assert isinstance(block.rows, Images)
        for i, t_ns in enumerate(block.log_ns.tolist()):
            packet = av.Packet(bytes(block.rows.bytes_.payload(i)))
            packet.pts = t_ns
            packets.append(packet)
    for sent in [*packets, None]:
        for frame in decoder.decode(sent):  # type: ignore[attr-defined]
            shown[frame.pts] = number_of(frame.to_ndarray(format="rgb24"))
    return shown


def number_of(rgb: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> int:
    """Number of a picture, from its grey level."""
    return round((float(rgb.mean()) - 10) / STEP)
