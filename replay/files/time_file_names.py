"""Find the time file of a folder of pictures or of a video."""

from pathlib import Path, PurePosixPath
from typing import Final

from crosscue.replay.errors import LogFormatError

# Names tried in this order inside a folder, before any ``.csv``.
NAMES: Final = ("timestamps.txt", "times.txt", "rgb.txt")


def find_time_file(folder: Path) -> Path | None:
    """Find the time file of a folder of pictures: inside it, or next to it with its name.

    Raises:
        LogFormatError: There are several candidates.
    """
    for name in NAMES:
        if (folder / name).is_file():
            return folder / name
    tables = sorted(folder.glob("*.csv"))
    if len(tables) > 1:
        names = ", ".join(path.name for path in tables[:5])
        raise LogFormatError(f"{folder}: several time files ({names}); name one timestamps.txt")
    beside = [folder.parent / f"{folder.name}{suffix}" for suffix in (".csv", ".txt")]
    if folder.name == "data":
        beside.append(folder.parent / "timestamps.txt")
    return next((path for path in [*tables, *beside] if path.is_file()), None)


def time_file_of_video(video: Path) -> Path | None:
    """Find the time file next to a video."""
    places = (video.with_name(name) for name in times_of_video(video.name))
    return next((place for place in places if place.is_file()), None)


def times_of_video(name: str) -> tuple[str, ...]:
    """Return ``<video>.txt``, ``<video>.csv``, with or without its suffix, by precedence."""
    stems = (name, PurePosixPath(name).stem)
    return tuple(stem + suffix for stem in stems for suffix in (".txt", ".csv"))
