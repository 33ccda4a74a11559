"""One small log of every format that ``open_log`` supports."""

import shutil
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import can
import numpy as np

from support.can_files import Sent, asc, blf, candump, python_can_message, random_frames, trc
from support.kitti_drive import kitti_odometry_drive, raw_drive
from support.nuscenes_drive import nuscenes_drive
from support.openpilot_drive import openpilot_drive
from support.pandaset_drive import pandaset_drive
from support.phone_drive import phone_drive
from support.pictures import picture_folder
from support.rosbag_files import rows_of, write_bag, write_folder
from support.videos import video

FRAMES: Final = 300


def _bytes(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def _mcap(folder: Path) -> Path:
    bag = write_folder(folder / "whole", rows_of(400), "mcap")
    return Path(shutil.move(str(next(bag.glob("*.mcap"))), folder / "log.mcap"))


def _db3(folder: Path) -> Path:
    bag = write_folder(folder / "whole", rows_of(400))
    return Path(shutil.move(str(next(bag.glob("*.db3"))), folder / "log.db3"))


def mf4(path: Path, frames: Sequence[Sent], compression: int = 2) -> Path:
    """Write a log with python-can, which uses asammdf."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        writer = can.MF4Writer(path, compression_level=compression)
        for frame in frames:
            writer(python_can_message(frame))
        writer.stop()
    return path


def _comma2k19(folder: Path) -> Path:
    rng = np.random.default_rng(5)
    place = folder / "processed_log" / "IMU" / "gyro"
    place.mkdir(parents=True)
    for name, rows in (("t", np.arange(500) * 0.01), ("value", rng.normal(size=(500, 3)))):
        with (place / name).open("wb") as file:
            np.save(file, rows)
    return folder


def _video(folder: Path) -> Path:
    path = video(folder / "front.mp4")
    (folder / "front.txt").write_text("".join(f"{0.05 * i:.2f}\n" for i in range(24)))
    return path


# For each name in ``FORMATS``, a function that writes a log into a folder and returns its path.
EVERY_FORMAT: Final[dict[str, Callable[[Path], Path]]] = {
    "mcap": _mcap,
    "rosbag1": lambda folder: write_bag(folder / "log.bag", rows_of(400)),
    "rosbag2-sqlite3": _db3,
    "rosbag2": lambda folder: write_folder(folder / "bag", rows_of(400)),
    "candump": lambda folder: _bytes(folder / "can.log", candump(random_frames(FRAMES))),
    "asc": lambda folder: _bytes(folder / "can.asc", asc(random_frames(FRAMES))),
    "blf": lambda folder: _bytes(folder / "can.blf", blf(random_frames(FRAMES))),
    "trc": lambda folder: _bytes(folder / "can.trc", trc(random_frames(FRAMES))),
    "mf4": lambda folder: mf4(folder / "can.mf4", random_frames(FRAMES)),
    "comma2k19": lambda folder: _comma2k19(folder / "segment"),
    "kitti-raw": lambda folder: raw_drive(folder / "drive"),
    "kitti-odometry": kitti_odometry_drive,
    "openpilot": lambda folder: openpilot_drive(folder / "segment"),
    "phone-drive": lambda folder: phone_drive(folder / "drive"),
    "nuscenes": lambda folder: nuscenes_drive(folder / "root"),
    "pandaset": lambda folder: pandaset_drive(folder / "002"),
    "video": _video,
    "images": lambda folder: picture_folder(folder / "front", 12, "rate_hz: 10\n"),
}
