"""Read a folder of road pictures: ``images/NAME.jpg`` with ``masks/NAME.png``, white for road."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from crosscue.datasets.scenes.export.road_frames import RoadFrames, shrunk
from crosscue.detectors.base import View
from crosscue.detectors.images import decode, read_file
from crosscue.replay.columns import Bytes
from crosscue.replay.errors import EmptyResultError, LogError, UsageError

SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".webp", ".bmp")


def load_folder(folder: Path, size_px: tuple[int, int]) -> RoadFrames:
    """Read all pictures of a folder with their masks, in order of names.

    Args:
        folder: Folder with ``images`` and ``masks``.
        size_px: Width and height of the result.

    Raises:
        UsageError: A picture and its mask have different sizes.
        EmptyResultError: There are no pictures.
        LogError: The folder of pictures is missing, or a picture or its mask is missing or does
            not decode.
    """
    images = sorted(
        path for path in (folder / "images").glob("*") if path.suffix.lower() in SUFFIXES
    )
    if not images:
        if not folder.joinpath("images").is_dir():
            raise LogError(f"{folder / 'images'}: no such folder; expected images and masks")
        raise EmptyResultError(f"{folder / 'images'}: no pictures; expected {', '.join(SUFFIXES)}")
    pixels, road = [], []
    for path in images:
        picture = _decoded(path, View())
        mask = _decoded(folder / "masks" / f"{path.stem}.png", View(is_grey=True))
        if mask.shape != picture.shape[:2]:
            raise UsageError(
                f"{path}: {picture.shape[1]} x {picture.shape[0]} pixels, but its mask has "
                f"{mask.shape[1]} x {mask.shape[0]}; expected equal sizes"
            )
        pixels.append(shrunk(picture, size_px))
        road.append(shrunk(np.where(mask > 127, 255, 0).astype(np.uint8), size_px))
    return RoadFrames(np.stack(pixels), np.stack(road))


def _decoded(path: Path, view: View) -> Bytes:
    try:
        return decode(read_file(path), view)[0]
    except OSError as error:
        raise LogError(f"{path}: {error.strerror}; expected a mask for every picture") from None
    except LogError as error:
        raise type(error)(f"{path}: {error}; repair or remove it") from None
