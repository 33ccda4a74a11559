"""For each format, damage to exactly one row of a log, as a flipped byte or a lost write brings."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Final

from support.can_files import blf, made
from support.every_format import EVERY_FORMAT
from support.mcap_files import McapFile, channel, message, schema
from support.rosbag_files import TOPICS, rows_of, write_bag


def _garbled_line(path: Path) -> None:
    """The middle line of a text log, illegible."""
    lines = path.read_bytes().splitlines(keepends=True)
    middle = len(lines) // 2
    lines[middle] = b"?" * (len(lines[middle]) - 1) + b"\n"
    path.write_bytes(b"".join(lines))


def _no_hexadecimal_digit(path: Path) -> None:
    """A line of a candump log with an identifier that is not a number."""
    lines = path.read_bytes().splitlines(keepends=True)
    stamp, bus, frame = lines[len(lines) // 2].split(b" ", 2)
    lines[len(lines) // 2] = b" ".join([stamp, bus, b"Z" + frame[1:]])
    path.write_bytes(b"".join(lines))


def _garbled_picture(folder: Path) -> None:
    pictures = sorted(folder.glob("*.png"))
    pictures[len(pictures) // 2].write_bytes(b"\x89PNG\r\n\x1a\n")


def _cut_jpeg(folder: Path) -> None:
    pictures = sorted(folder.glob("camera/*/*.jpg"))
    whole = pictures[len(pictures) // 2]
    whole.write_bytes(whole.read_bytes()[:-20])


def _cut_png(folder: Path) -> None:
    pictures = sorted(folder.rglob("*.png"))
    whole = pictures[len(pictures) // 2]
    whole.write_bytes(whole.read_bytes()[:-20])


def _null_payload(path: Path) -> None:
    """One row whose payload is gone."""
    file = path if path.is_file() else next(path.glob("*.db3"))
    with sqlite3.connect(file) as database:
        database.execute("UPDATE messages SET topic_id = 999 WHERE rowid = 100")
    database.close()


def _mcap(folder: Path) -> Path:
    """Messages without a chunk around them, so that no checksum covers more than one."""
    messages = [message(1, 10 * i, b"%4d" % i) for i in range(20)]
    file = McapFile([schema(1), channel(1, 1, "/a"), *messages], summary=False)
    path = folder / "log.mcap"
    path.write_bytes(file.coded())
    return path


def _mcap_of_no_channel(path: Path) -> None:
    coded = bytearray(path.read_bytes())
    at = coded.index(message(1, 100, b"%4d" % 10))
    coded[at + 9 : at + 11] = struct.pack("<H", 77)
    path.write_bytes(coded)


def _blf(folder: Path) -> Path:
    path = folder / "can.blf"
    path.write_bytes(blf(made(60, fd=False), stored=True, container=1 << 20))
    return path


def _blf_of_no_length(path: Path) -> None:
    """One frame of a length that CAN does not have."""
    coded = bytearray(path.read_bytes())
    at = -1
    for _ in range(30):
        at = coded.index(b"LOBJ", at + 1)
    # Behind object and frame header come channel and flags, then the length code.
    coded[at + 32 + 3] = 0xFF
    path.write_bytes(coded)


def _bag(folder: Path) -> Path:
    return write_bag(folder / "log.bag", rows_of(40, topics=TOPICS[:4]))


def _bag_of_no_connection(path: Path) -> None:
    """One message's connection number, which no connection has."""
    coded = bytearray(path.read_bytes())
    at = -1
    mark = b"\x09\x00\x00\x00conn="
    found = []
    while (at := coded.find(mark, at + 1)) >= 0:
        found.append(at)
    # Messages carry op=0x02 beside it; take one amid the first chunk.
    messages = [one for one in found if b"op=\x02" in coded[one - 12 : one + 40]]
    coded[messages[5] + len(mark) : messages[5] + len(mark) + 4] = struct.pack("<I", 99)
    path.write_bytes(coded)


def _speed_without_a_number(path: Path) -> None:
    """One row of the car's speed; its line's other values are as they were."""
    file = path / "made_car.csv"
    lines = file.read_text(encoding="utf-8").splitlines()
    lines[20] = lines[20].replace(",20.0,", ",2x.0,")
    file.write_text("\n".join(lines), encoding="utf-8")


ONE_ROW: Final[dict[str, tuple[Callable[[Path], Path], Callable[[Path], None]]]] = {
    "candump": (EVERY_FORMAT["candump"], _no_hexadecimal_digit),
    "asc": (EVERY_FORMAT["asc"], _garbled_line),
    "trc": (EVERY_FORMAT["trc"], _garbled_line),
    "blf": (_blf, _blf_of_no_length),
    "mcap": (_mcap, _mcap_of_no_channel),
    "rosbag1": (_bag, _bag_of_no_connection),
    "rosbag2-sqlite3": (EVERY_FORMAT["rosbag2-sqlite3"], _null_payload),
    "rosbag2": (EVERY_FORMAT["rosbag2"], _null_payload),
    "images": (EVERY_FORMAT["images"], _garbled_picture),
    "kitti-odometry": (EVERY_FORMAT["kitti-odometry"], _cut_png),
    "phone-drive": (EVERY_FORMAT["phone-drive"], _speed_without_a_number),
    "nuscenes": (EVERY_FORMAT["nuscenes"], _cut_png),
    "pandaset": (EVERY_FORMAT["pandaset"], _cut_jpeg),
}
"""By format: writes a log, and damages one row of it."""
