"""Small simulated pictures, encoded."""

import shutil
import struct
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

SIDE_PX: Final = 60_000


def picture(number: int, suffix: str = ".png", width: int = 24, height: int = 16) -> bytes:
    """A picture whose grey level is its number, encoded in the format of the suffix."""
    grey = np.full((height, width), number % 256, dtype=np.uint8)
    grey[:, ::2] ^= np.uint8(15)
    ok, encoded = cv2.imencode(suffix, grey)
    assert ok
    return encoded.tobytes()


def picture_folder(
    folder: Path, count: int, times: str | None = None, suffix: str = ".png"
) -> Path:
    """Write ``frame_0`` to ``frame_<count - 1>`` and optionally ``timestamps.txt``."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        (folder / f"frame_{number}{suffix}").write_bytes(picture(number, suffix))
    if times is not None:
        (folder / "timestamps.txt").write_text(times, encoding="utf-8")
    return folder


def picture_log(
    folder: Path, pictures: Iterable[Path | NDArray[np.uint8]], rate_hz: float = 10.0
) -> Path:
    """Write files under their names and pixels as ``frame_0.png``..., at a rate."""
    folder.mkdir(parents=True)
    for number, one in enumerate(pictures):
        if isinstance(one, Path):
            shutil.copy(one, folder)
        else:
            cv2.imwrite(str(folder / f"frame_{number}.png"), one)
    (folder / "timestamps.txt").write_text(f"rate_hz: {rate_hz}\n")
    return folder


def _png() -> bytes:
    def part(kind: bytes, body: bytes) -> bytes:
        crc = struct.pack(">I", zlib.crc32(kind + body))
        return struct.pack(">I", len(body)) + kind + body + crc

    head = struct.pack(">IIBBBBB", SIDE_PX, SIDE_PX, 8, 2, 0, 0, 0)
    body = zlib.compress(bytes(1 << 20))
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", body) + part(b"IEND", b"")


def _jpeg() -> bytes:
    size = struct.pack(">BHHB", 8, SIDE_PX, SIDE_PX, 3) + b"\1\x11\0\2\x11\0\3\x11\0"
    frame = b"\xff\xc0" + struct.pack(">H", 2 + len(size)) + size
    return b"\xff\xd8" + frame + b"\xff\xda\0\x0c\3\1\0\2\0\3\0\0?\0" + bytes(1000) + b"\xff\xd9"


def _webp() -> bytes:
    body = b"WEBPVP8X" + struct.pack("<I", 10) + bytes(4)
    body += (SIDE_PX - 1).to_bytes(3, "little") * 2 + bytes(100)
    return b"RIFF" + struct.pack("<I", len(body)) + body


# Small pictures of ``SIDE_PX`` by ``SIDE_PX`` pixels, by coding.
OVERSIZED: Final[dict[str, Callable[[], bytes]]] = {"png": _png, "jpeg": _jpeg, "webp": _webp}
