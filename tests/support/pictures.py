"""Small simulated pictures, encoded."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np


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
