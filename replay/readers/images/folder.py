"""Reader of a folder with the images of one camera and a time file.

``time_file`` parses the time file, and ``timed_files`` pairs images with times. The topic has the
name of the folder.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from crosscue.replay.base import Log
from crosscue.replay.columns import Topic
from crosscue.replay.errors import LogFormatError
from crosscue.replay.files.time_file_names import find_time_file
from crosscue.replay.limits import DEFAULT_LIMITS, Limits
from crosscue.replay.readers.held_rows import CameraDrive
from crosscue.replay.readers.time_file import read_time_file
from crosscue.replay.readers.timed_files import pair_with_times

from .files import PictureFiles, list_pictures


class ImageFolder(CameraDrive):
    """A folder of images as a ``Log``, in natural order of their names."""

    format: Final = "images"


def open_images(path: Path, limits: Limits) -> ImageFolder:
    """Open a folder of images; see ``crosscue.replay.formats.FORMATS``.

    Raises:
        LogFormatError: There is no image or no time file, or the time file cannot be parsed.
    """
    paths = list_pictures(path)
    if not paths:
        raise LogFormatError(f"{path}: no picture in it; expected .png, .jpg or .webp files")
    time_file = find_time_file(path)
    if time_file is None:
        raise LogFormatError(
            f"{path}: {len(paths)} pictures but no time file; write timestamps.txt into it with "
            "one time per line (seconds with a decimal point), or with the single line "
            "'rate_hz: 15' if their times were not recorded"
        )
    times = read_time_file(time_file, limits)
    name = path.resolve()
    camera = name.parent.name if name.name == "data" else name.name
    files = pair_with_times(paths, times)
    topic = Topic(camera or "images", "crosscue/Images", "columns", declared=files.declared)
    pictures = PictureFiles(topic, files)
    if time_file.parent == path:
        pictures.touched.add(time_file, 0, time_file.stat().st_size)
    return ImageFolder(path, [pictures], (), limits, pictures.touched)


def picture_names(log: Log) -> Mapping[str, int]:
    """Return the times of a folder's images by file name."""
    if log.format != "images":
        return {}
    time_file = find_time_file(log.path)
    assert time_file is not None
    files = pair_with_times(list_pictures(log.path), read_time_file(time_file, DEFAULT_LIMITS))
    return {
        path.name: t_ns
        for path, t_ns in zip(files.paths, files.t_ns.tolist(), strict=True)
        if t_ns >= 0
    }
