"""Road pictures of one's own: ``images/NAME.jpg`` with ``masks/NAME.png``, white where road is."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from crosscue.datasets.scenes.road_frames import RoadFrames, shrunk
from crosscue.detectors.base import View
from crosscue.detectors.pictures import Encoded, decode
from crosscue.replay.columns import Bytes
from crosscue.replay.errors import LogFormatError, LogTooLargeError, UsageError
from crosscue.replay.limits import DEFAULT

CODINGS: Final = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png", ".webp": "webp", ".bmp": "bmp"}


def load_folder(folder: Path, size_px: tuple[int, int]) -> RoadFrames:
    """All pictures of a folder that have a mask, by name.

    Args:
        folder: With ``images`` and ``masks``.
        size_px: Width and height wanted.

    Raises:
        UsageError: No pictures, one without a mask, or of another size than its mask, or one that
            does not decode.
    """
    images = sorted(
        path for path in (folder / "images").glob("*") if path.suffix.lower() in CODINGS
    )
    if not images:
        raise UsageError(f"{folder / 'images'}: no pictures; want {', '.join(CODINGS)}")
    pixels, road = [], []
    for path in images:
        picture = _decoded(path, View())
        mask = _decoded(folder / "masks" / f"{path.stem}.png", View(is_grey=True))
        if mask.shape != picture.shape[:2]:
            raise UsageError(
                f"{path}: {picture.shape[1]} x {picture.shape[0]} pixels, but its mask has "
                f"{mask.shape[1]} x {mask.shape[0]}; make them alike"
            )
        pixels.append(shrunk(picture, size_px))
        road.append(shrunk(np.where(mask > 127, 255, 0).astype(np.uint8), size_px))
    return RoadFrames(np.stack(pixels), np.stack(road))


def _decoded(path: Path, view: View) -> Bytes:
    try:
        if path.stat().st_size > DEFAULT.message_bytes:
            raise UsageError(f"{path}: more than {DEFAULT.message_bytes:,} bytes; want a picture")
        content = path.read_bytes()
        return decode(Encoded(CODINGS[path.suffix.lower()], memoryview(content)), view)[0]
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}; every picture wants its mask") from None
    except (LogFormatError, LogTooLargeError) as error:
        raise UsageError(f"{path}: {error}; mend it or take it out") from None
