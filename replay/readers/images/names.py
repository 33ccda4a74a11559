"""What the files of a folder of pictures are called."""

from __future__ import annotations

from collections.abc import Mapping

from crosscue.replay.base import DEFAULT_LIMITS, Log
from crosscue.replay.decode.coding import IMAGE_SUFFIXES
from crosscue.replay.files.time_file_names import find_time_file
from crosscue.replay.readers.time_file import read_time_file
from crosscue.replay.readers.timed_files import list_files, pair


def picture_names(log: Log) -> Mapping[str, int]:
    """From file name to time, for a folder of pictures."""
    if log.format != "images":
        return {}
    time_file = find_time_file(log.path)
    assert time_file is not None
    files = pair(list_files(log.path, IMAGE_SUFFIXES), read_time_file(time_file, DEFAULT_LIMITS))
    return {
        path.name: t_ns
        for path, t_ns in zip(files.paths, files.t_ns.tolist(), strict=True)
        if t_ns >= 0
    }
