"""The table of supported log formats and their readers.

A new format takes one module and one line in ``FORMATS``. The module defines a function with the
signature ``(path, limits) -> Log`` and is imported on demand.
"""

import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Final

from crosscue.replay.errors import LogError, UnknownFormatError

from .plugins import loaded


@dataclass(frozen=True, slots=True)
class Format:
    """One log format and its reader.

    Attributes:
        suffixes: Lower-case file suffixes; empty for folders recognised by ``markers``.
        markers: Relative paths or glob patterns; a folder that contains one of them matches.
        opener: ``module:function``, called with the path and limits.
        says: Name of the format in messages.
    """

    suffixes: tuple[str, ...]
    markers: tuple[str, ...]
    opener: str
    says: str


@dataclass(frozen=True, slots=True)
class DataSet:
    """A data set: a format whose logs include ground truth.

    Attributes:
        format: The format of its logs.
        truth: ``module:function`` that takes a log's path and a folder, writes ``truth.json`` into
            the folder and returns its path.
    """

    format: Format
    truth: str


# Folders are matched in this order, so data sets come before folders of images.
FORMATS: Final[dict[str, Format]] = {
    "mcap": Format((".mcap",), (), "crosscue.replay.readers.mcap.reader:McapLog", "MCAP"),
    "rosbag1": Format(
        (".bag", ".active"), (), "crosscue.replay.readers.rosbag1.reader:BagLog", "ROS 1 bag"
    ),
    "rosbag2-sqlite3": Format(
        (".db3",), (), "crosscue.replay.readers.rosbag2.db3:Db3Log", "ROS 2 bag (sqlite3)"
    ),
    "rosbag2": Format(
        (),
        ("metadata.yaml", "*.db3", "*.mcap", "*.db3.zstd", "*.mcap.zstd"),
        "crosscue.replay.readers.rosbag2.folder:FolderLog",
        "ROS 2 bag folder",
    ),
    "candump": Format(
        (".log", ".candump"),
        (),
        "crosscue.replay.readers.can_text.candump:open_candump",
        "candump log",
    ),
    "asc": Format((".asc",), (), "crosscue.replay.readers.can_text.asc:open_asc", "Vector ASC log"),
    "blf": Format((".blf",), (), "crosscue.replay.readers.blf.reader:BlfLog", "Vector BLF log"),
    "trc": Format((".trc",), (), "crosscue.replay.readers.can_text.trc:open_trc", "PEAK TRC log"),
    "mf4": Format((".mf4",), (), "crosscue.replay.readers.mf4.reader:Mf4Log", "ASAM MDF 4"),
    "comma2k19": Format(
        (),
        ("processed_log", "global_pose"),
        "crosscue.datasets.adapters.comma2k19:open_segment",
        "comma2k19 segment",
    ),
    "kitti-raw": Format(
        (),
        ("oxts/data", "oxts/timestamps.txt", "oxts/*.txt"),
        "crosscue.datasets.adapters.kitti:open_kitti",
        "KITTI raw drive",
    ),
    "kitti-odometry": Format(
        (),
        ("image_[0-9]/*.png",),
        "crosscue.datasets.adapters.kitti_odometry:open_kitti_odometry",
        "KITTI odometry sequence",
    ),
    "openpilot": Format(
        (),
        ("rlog", "rlog.bz2", "rlog.zst", "qlog", "qlog.bz2", "qlog.zst"),
        "crosscue.datasets.adapters.openpilot:open_openpilot",
        "openpilot segment",
    ),
    "phone-drive": Format(
        (),
        ("*_phone.csv",),
        "crosscue.datasets.adapters.phone_drive:open_phone_drive",
        "smartphone driving data set (folder)",
    ),
    "nuscenes": Format(
        (".nuscenes",),
        ("v1.0-*/scene.json",),
        "crosscue.datasets.adapters.nuscenes:open_scene",
        "nuScenes scene",
    ),
    "pandaset": Format(
        (),
        ("camera/*/poses.json",),
        "crosscue.datasets.adapters.pandaset:open_pandaset",
        "PandaSet sequence",
    ),
    "video": Format(
        (".mp4", ".avi", ".mkv", ".mov", ".hevc", ".h264"),
        (),
        "crosscue.replay.readers.images.video:open_video",
        "video with a time file",
    ),
    "images": Format(
        (),
        ("*.png", "*.jpg", "*.jpeg", "*.webp", "*.PNG", "*.JPG", "*.JPEG"),
        "crosscue.replay.readers.images.folder:open_images",
        "folder of images with a time file",
    ),
}


def known_formats() -> dict[str, Format]:
    """Return every format by name: the built-in formats, then those of installed plug-ins."""
    return _formats_on(tuple(sys.path))


@lru_cache(maxsize=4)
def _formats_on(path: tuple[str, ...]) -> dict[str, Format]:
    """Load the formats once for each ``sys.path``; a plug-in that fails warns once."""
    found = FORMATS | dict(loaded("reader", Format, FORMATS))
    return found | {name: one.format for name, one in data_sets(found).items()}


def data_sets(taken: Collection[str] = ()) -> dict[str, DataSet]:
    """Return the data sets of installed packages, by name."""
    return dict(loaded("dataset", DataSet, {*FORMATS, *taken}))


def format_of(path: Path) -> str:
    """Return the name of the format of a file or folder.

    Raises:
        UnknownFormatError: No format matches; the message lists the known formats.
        LogError: The path does not exist, or is not a file or folder.
    """
    try:
        is_folder, is_file = path.is_dir(), path.is_file()
        if not is_folder and not is_file:
            what = "not a regular file or folder" if path.exists() else "no such file or folder"
            raise LogError(f"{path}: {what}; expected a log file or folder")
        if is_folder:
            # ``glob`` silently finds nothing in a folder without read permission.
            next(path.iterdir(), None)
    except OSError as error:
        raise LogError(f"{path}: {error.strerror or error}; check the path") from None
    name = _fitting(path, is_folder, FORMATS) or _fitting(path, is_folder, known_formats())
    if name is None:
        raise unknown_format(path, "a folder without a known log in it" if is_folder else None)
    return name


def has_known_suffix(name: str) -> bool:
    """Return whether the suffix of a file's name is that of a format."""
    suffix = PurePosixPath(name).suffix.lower()
    return any(suffix in known.suffixes for known in known_formats().values())


def unknown_format(place: Path | str, what: str | None = None) -> UnknownFormatError:
    """Return the error for a file or folder that no reader supports; it lists the formats."""
    wanted = ", ".join(
        f"{f.says} ({' '.join(f.suffixes) if f.suffixes else 'folder'})"
        for f in known_formats().values()
    )
    what = what or f"suffix {PurePosixPath(place).suffix.lower()!r} unknown"
    return UnknownFormatError(f"{place}: {what}; there are: {wanted}")


def _fitting(path: Path, is_folder: bool, formats: Mapping[str, Format]) -> str | None:
    suffix = path.suffix.lower()
    for name, known in formats.items():
        if not is_folder and suffix in known.suffixes:
            return name
        if is_folder and any(_holds(path, marker) for marker in known.markers):
            return name
    return None


def _holds(folder: Path, marker: str) -> bool:
    try:
        return next(folder.glob(marker), None) is not None
    except OSError:
        return False
