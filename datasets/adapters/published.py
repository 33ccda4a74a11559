"""What adapters of data sets share: bounded files, numbered pictures, odometry of poses."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from crosscue.replay.columns import Floats, Int64s, Table, Topic
from crosscue.replay.errors import LogFormatError
from crosscue.replay.files.bounded import read_whole
from crosscue.replay.files.tree_text import json_tree
from crosscue.replay.limits import MIB
from crosscue.replay.readers.held_rows import HeldRows, Loss
from crosscue.replay.readers.images.files import PictureFiles
from crosscue.replay.readers.timed_files import TimedFiles
from crosscue.replay.seal.touched import Touched

MAX_FILE_BYTES: Final = 64 * MIB


def content_of(path: Path, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Read a file.

    Raises:
        LogFormatError: It cannot be read, or is too large.
    """
    try:
        return read_whole(path, max_bytes)
    except OSError as error:
        raise LogFormatError(f"{path}: {error.strerror}; restore the file") from None


def lines_of(path: Path, max_bytes: int = MAX_FILE_BYTES) -> list[str]:
    """Read the lines of a text file; see ``content_of``."""
    return content_of(path, max_bytes).decode("utf-8", errors="replace").splitlines()


def json_of(path: Path) -> Any:
    """Read a JSON file; see ``content_of``."""
    try:
        return json_tree(content_of(path))
    except ValueError as error:
        raise LogFormatError(f"{path}: not JSON: {error}") from None


def note_whole(touched: Touched, *files: Path) -> None:
    """Record that files are read completely."""
    for file in files:
        touched.add(file, 0, file.stat().st_size)


def camera_of(name: str, files: TimedFiles, touched: Touched) -> PictureFiles:
    """Return a camera with the pictures of its folder."""
    topic = Topic(name, "crosscue/Images", "columns", declared=files.declared)
    return PictureFiles(topic, files, touched)


def numbered_files(paths: Sequence[Path], t_ns: Int64s) -> TimedFiles:
    """Assign the time with index NN to the file named ``NN``."""
    numbered = [p.stem.isascii() and p.stem.isdecimal() and len(p.stem) < 10 for p in paths]
    places = np.array(
        [int(p.stem) if is_so else -1 for p, is_so in zip(paths, numbered, strict=True)], np.int64
    )
    is_timed = (places >= 0) & (places < len(t_ns))
    found = np.full(len(paths), -1, np.int64)
    found[is_timed] = t_ns[places[is_timed]]
    is_missing = np.ones(len(t_ns), np.bool_)
    is_missing[places[is_timed]] = False
    return TimedFiles(tuple(paths), found, t_ns[is_missing], len(t_ns), ())


def odometry_of(
    t_ns: Int64s,
    xyz_m: Floats,
    forward: Floats,
    declared: int,
    losses: tuple[Loss, ...] = (),
    heading_rad: Floats | None = None,
) -> HeldRows:
    """Return forward speed and yaw rate, from differences between neighbouring poses.

    A rigid vehicle has the same forward speed everywhere along its axis, so this is the speed of
    the rear axle. Differences are one-sided at both ends.

    Args:
        t_ns: Times, shape (N,).
        xyz_m: Positions, shape (N, 2) or (N, 3).
        forward: Directions of the vehicle's axis, of the same shape.
        declared: Expected number of poses.
        losses: Poses that could not be parsed.
        heading_rad: Headings, continuous; by default those of ``forward``.
    """
    seconds = (t_ns - t_ns[0]) * 1e-9
    velocity = np.gradient(xyz_m, seconds, axis=0)
    if heading_rad is None:
        heading_rad = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    table = Table(
        {
            "speed_x_mps": np.asarray((velocity * forward).sum(axis=1), np.float64),
            "yaw_rate_radps": np.gradient(heading_rad, seconds),
        }
    )
    topic = Topic("odometry", "nav_msgs/msg/Odometry", "columns", declared=declared)
    return HeldRows(topic, t_ns, table, losses)
