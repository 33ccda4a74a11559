"""For each format, damage to exactly one row of a log, as by a flipped byte or a lost write."""

import bz2
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Final

from support.can_files import blf, random_frames
from support.every_format import EVERY_FORMAT
from support.mcap_files import McapFile, channel, message, schema
from support.openpilot_drive import START_NS, TURN, event
from support.rosbag_files import TOPICS, rows_of, write_bag
from support.trees import written


def _garbled_line(path: Path) -> None:
    """Replace the middle line of a text log by question marks."""
    lines = path.read_bytes().splitlines(keepends=True)
    middle = len(lines) // 2
    lines[middle] = b"?" * (len(lines[middle]) - 1) + b"\n"
    path.write_bytes(b"".join(lines))


def _invalid_identifier(path: Path) -> None:
    """Replace a digit of an identifier in a candump log by a letter that is not hexadecimal."""
    lines = path.read_bytes().splitlines(keepends=True)
    stamp, bus, frame = lines[len(lines) // 2].split(b" ", 2)
    lines[len(lines) // 2] = b" ".join([stamp, bus, b"Z" + frame[1:]])
    path.write_bytes(b"".join(lines))


def _garbled_picture(folder: Path) -> None:
    pictures = sorted(folder.glob("*.png"))
    pictures[len(pictures) // 2].write_bytes(b"\x89PNG\r\n\x1a\n")


def _cut_jpeg(folder: Path) -> None:
    pictures = sorted(folder.glob("camera/*/*.jpg"))
    path = pictures[len(pictures) // 2]
    path.write_bytes(path.read_bytes()[:-20])


def _cut_png(folder: Path) -> None:
    pictures = sorted(folder.rglob("*.png"))
    path = pictures[len(pictures) // 2]
    path.write_bytes(path.read_bytes()[:-20])


def _unknown_topic(path: Path) -> None:
    """Refer one message to a topic that does not exist."""
    file = path if path.is_file() else next(path.glob("*.db3"))
    with sqlite3.connect(file) as database:
        database.execute("UPDATE messages SET topic_id = 999 WHERE rowid = 100")
    database.close()


def _mcap(folder: Path) -> Path:
    """Write messages without chunks, so that no checksum covers more than one."""
    messages = [message(1, 10 * i, b"%4d" % i) for i in range(20)]
    file = McapFile([schema(1), channel(1, 1, "/a"), *messages], summary=False)
    return written(folder / "log.mcap", file.coded())


def _unknown_channel(path: Path) -> None:
    coded = bytearray(path.read_bytes())
    at = coded.index(message(1, 100, b"%4d" % 10))
    coded[at + 9 : at + 11] = struct.pack("<H", 77)
    path.write_bytes(coded)


def _blf(folder: Path) -> Path:
    path = folder / "can.blf"
    path.write_bytes(blf(random_frames(60, fd=False), stored=True, container=1 << 20))
    return path


def _invalid_length(path: Path) -> None:
    """Give one frame a length code that CAN does not define."""
    coded = bytearray(path.read_bytes())
    at = -1
    for _ in range(30):
        at = coded.index(b"LOBJ", at + 1)
    # The length code follows the object and frame headers, the channel and the flags.
    coded[at + 32 + 3] = 0xFF
    path.write_bytes(coded)


def _bag(folder: Path) -> Path:
    return write_bag(folder / "log.bag", rows_of(40, topics=TOPICS[:4]))


def _unknown_connection(path: Path) -> None:
    """Replace the connection number of one message by an unused one."""
    coded = bytearray(path.read_bytes())
    at = -1
    mark = b"\x09\x00\x00\x00conn="
    found = []
    while (at := coded.find(mark, at + 1)) >= 0:
        found.append(at)
    # Message records have op=0x02 in the same header; this is the sixth of them.
    messages = [one for one in found if b"op=\x02" in coded[one - 12 : one + 40]]
    coded[messages[5] + len(mark) : messages[5] + len(mark) + 4] = struct.pack("<I", 99)
    path.write_bytes(coded)


def _speed_without_a_number(path: Path) -> None:
    """Damage the speed in one line, and leave the line's other values."""
    file = path / "made_car.csv"
    lines = file.read_text(encoding="utf-8").splitlines()
    lines[20] = lines[20].replace(",20.0,", ",2x.0,")
    file.write_text("\n".join(lines), encoding="utf-8")


def _pointer_out_of_its_message(path: Path) -> None:
    """Damage the pointer of one message, and leave its table of segments."""
    log = path / "rlog.bz2"
    coded = bytearray(bz2.decompress(log.read_bytes()))
    at = coded.index(event(START_NS + 50_002_000, gyroscope=TURN))
    # The root pointer is behind the table; the pointer behind two words of data follows it.
    coded[at + 8 + 8 + 16 + 3] = 0x7F
    log.write_bytes(bz2.compress(bytes(coded)))


# For each format, a function that writes a log, and one that damages one row of it.
ONE_ROW: Final[dict[str, tuple[Callable[[Path], Path], Callable[[Path], None]]]] = {
    "candump": (EVERY_FORMAT["candump"], _invalid_identifier),
    "asc": (EVERY_FORMAT["asc"], _garbled_line),
    "trc": (EVERY_FORMAT["trc"], _garbled_line),
    "blf": (_blf, _invalid_length),
    "mcap": (_mcap, _unknown_channel),
    "rosbag1": (_bag, _unknown_connection),
    "rosbag2-sqlite3": (EVERY_FORMAT["rosbag2-sqlite3"], _unknown_topic),
    "rosbag2": (EVERY_FORMAT["rosbag2"], _unknown_topic),
    "images": (EVERY_FORMAT["images"], _garbled_picture),
    "kitti-odometry": (EVERY_FORMAT["kitti-odometry"], _cut_png),
    "openpilot": (EVERY_FORMAT["openpilot"], _pointer_out_of_its_message),
    "phone-drive": (EVERY_FORMAT["phone-drive"], _speed_without_a_number),
    "nuscenes": (EVERY_FORMAT["nuscenes"], _cut_png),
    "pandaset": (EVERY_FORMAT["pandaset"], _cut_jpeg),
}
