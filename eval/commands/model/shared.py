"""What the model commands share."""

from __future__ import annotations

from pathlib import Path

from crosscue.detectors.base import Detections, Detector, Frame, View
from crosscue.detectors.catalog.entries import card_path
from crosscue.detectors.images import decode, read_file
from crosscue.detectors.overlay import picture_of
from crosscue.replay.base import Bytes, LogError, write_bytes


def card_of(name: str) -> Path:
    """A card's file, from its name or the catalog's.

    Raises:
        UsageError: The catalog has no such model.
    """
    return Path(name) if name.endswith(".toml") else card_path(name)


def pixels_of(picture: Path) -> tuple[Bytes, tuple[int, int]]:
    """A picture file's pixels, (H, W, 3) blue green red, and its width and height.

    Raises:
        LogError: It cannot be read or decoded.
    """
    try:
        return decode(read_file(picture), View())
    except OSError as error:
        raise LogError(f"{picture}: {error.strerror}; give a JPEG, PNG or WebP file") from None
    except LogError as error:
        raise type(error)(f"{picture}: {error}") from None


def look(detector: Detector, picture: Path, output: Path) -> Detections | None:
    """Run a detector over one picture and draw what it finds; None where it finds road.

    Raises:
        LogError: It cannot be read or decoded.
        OutputError: The drawing cannot be written.
    """
    pixels, size = pixels_of(picture)
    (found,) = detector([Frame(0, "", pixels, size)])
    write_bytes(output, picture_of(pixels, found))
    return found if isinstance(found, Detections) else None
