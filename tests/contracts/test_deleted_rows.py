"""Formats with a row counter report exactly one missing row if one is removed from a log."""

import bz2
import json
import shutil
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from crosscue.replay.formats import FORMATS
from support.accounted import read
from support.can_files import blf, random_frames, trc
from support.commands import output_of
from support.every_format import EVERY_FORMAT, FRAMES
from support.mcap_files import McapFile, channel, schema
from support.mcap_files import message as mcap_message
from support.openpilot_drive import drive_messages
from support.pictures import picture_folder
from support.rosbag_files import START_NS, bag, chunk, connection, message, record, stamp, u32
from support.videos import video

DOCS: Final = Path(__file__).parents[2] / "docs" / "reference" / "formats.md"


def _mcap(folder: Path) -> Path:
    """Write a file without chunks and checksums, whose statistics count one message more."""
    messages = [mcap_message(1, START_NS + k, b"message %02d" % k) for k in range(40)]
    file = McapFile([schema(1), channel(1, 1, "/a"), *messages], summary_crc=False)
    raw = bytearray(file.coded().replace(messages[20], b""))
    (summary_at,) = struct.unpack_from("<Q", raw, len(raw) - 28)
    struct.pack_into("<Q", raw, len(raw) - 28, summary_at - len(messages[20]))
    path = folder / "log.mcap"
    path.write_bytes(raw)
    return path


def _bag(folder: Path) -> Path:
    """Write a bag with ten messages in its index and nine in its chunk."""
    link = connection(0, b"/a")
    rows = [message(0, START_NS + k, b"message") for k in range(10) if k != 5]
    stored = chunk(link + b"".join(rows))
    path = folder / "log.bag"
    begin = bag(path).stat().st_size
    info = record(
        u32(0) + u32(10),
        op=b"\x06",
        ver=u32(1),
        chunk_pos=struct.pack("<Q", begin),
        start_time=stamp(START_NS),
        end_time=stamp(START_NS + 9),
        count=u32(1),
    )
    index_at = struct.pack("<Q", begin + len(stored))
    return bag(path, stored, link, info, index_pos=index_at, conn_count=u32(1), chunk_count=u32(1))


def _without_row(database: Path) -> None:
    with sqlite3.connect(database) as connection:
        done = connection.execute("DELETE FROM messages WHERE id = 200")
        assert done.rowcount == 1
    connection.close()


def _db3(folder: Path) -> Path:
    log = EVERY_FORMAT["rosbag2-sqlite3"](folder)
    _without_row(log)
    return log


def _rosbag2(folder: Path) -> Path:
    log = EVERY_FORMAT["rosbag2"](folder)
    _without_row(next(log.glob("*.db3")))
    return log


def _blf(folder: Path) -> Path:
    frames = random_frames(FRAMES)
    raw = bytearray(blf(frames[:150] + frames[151:]))
    (objects,) = struct.unpack_from("<L", raw, 32)
    assert objects == FRAMES - 1
    struct.pack_into("<L", raw, 32, FRAMES)
    path = folder / "can.blf"
    path.write_bytes(raw)
    return path


def _trc(folder: Path) -> Path:
    lines = trc(random_frames(FRAMES)).splitlines(keepends=True)
    del lines[len(lines) // 2]
    path = folder / "can.trc"
    path.write_bytes(b"".join(lines))
    return path


def _mf4(folder: Path) -> Path:
    """Write a file in which a group has one record fewer than its counter states."""
    path = EVERY_FORMAT["mf4"](folder)
    raw = bytearray(path.read_bytes())
    at = -1
    while (at := raw.find(b"##CG", at + 1)) >= 0:
        (count,) = struct.unpack_from("<Q", raw, at + 80)
        if count > 1:
            struct.pack_into("<Q", raw, at + 80, count + 1)
            break
    assert at >= 0
    path.write_bytes(raw)
    return path


def _comma2k19(folder: Path) -> Path:
    log = EVERY_FORMAT["comma2k19"](folder)
    path = log / "processed_log" / "IMU" / "gyro" / "value"
    rows = np.load(path)
    with path.open("wb") as file:
        np.save(file, np.delete(rows, 250, axis=0))
    return log


def _kitti(folder: Path) -> Path:
    log = EVERY_FORMAT["kitti-raw"](folder)
    sorted((log / "image_02" / "data").iterdir())[15].unlink()
    return log


def _video(folder: Path) -> Path:
    path = video(folder / "front.mp4", 23)
    (folder / "front.txt").write_text("".join(f"{0.05 * i:.2f}\n" for i in range(24)))
    return path


def _images(folder: Path) -> Path:
    times = "".join(f"{0.1 * i:.1f}\n" for i in range(12))
    log = picture_folder(folder / "front", 12, times)
    (log / "frame_6.png").unlink()
    return log


def _without_a_picture(name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        log = EVERY_FORMAT[name](folder)
        sorted(log.rglob("*.png"))[7].unlink()
        return log

    return write


def _pandaset(folder: Path) -> Path:
    log = EVERY_FORMAT["pandaset"](folder)
    fixes = json.loads((log / "meta" / "gps.json").read_text())
    (log / "meta" / "gps.json").write_text(json.dumps(fixes[:7] + fixes[8:]))
    return log


# Formats that count their rows, and functions that write a log with one row removed.
ONE_REMOVED: Final[dict[str, Callable[[Path], Path]]] = {
    "mcap": _mcap,
    "rosbag1": _bag,
    "rosbag2-sqlite3": _db3,
    "rosbag2": _rosbag2,
    "blf": _blf,
    "trc": _trc,
    "mf4": _mf4,
    "comma2k19": _comma2k19,
    "kitti-raw": _kitti,
    "kitti-odometry": _without_a_picture("kitti-odometry"),
    "nuscenes": _without_a_picture("nuscenes"),
    "pandaset": _pandaset,
    "video": _video,
    "images": _images,
}
# Formats in which a removed row cannot be detected, with their names in the docs.
WITHOUT_COUNTER: Final = {
    "candump": "candump",
    "asc": "ASC",
    "openpilot": "openpilot",
    "phone-drive": "smartphone driving data set",
}


def test_every_format_is_classified_by_row_counter() -> None:
    assert ONE_REMOVED.keys() | WITHOUT_COUNTER.keys() == FORMATS.keys()
    assert not ONE_REMOVED.keys() & WITHOUT_COUNTER.keys()


@pytest.mark.parametrize("name", sorted(ONE_REMOVED))
def test_removed_row_is_reported_as_one_dropped_row(name: str, tmp_path: Path) -> None:
    log = ONE_REMOVED[name](tmp_path)

    _, ledger = read(log)

    accounts = ledger.accounts.values()
    assert sum(account.dropped.total() for account in accounts) == 1, ledger.details
    assert not any(account.dropped_unknown for account in accounts), ledger.details
    assert "losses" in output_of("info", log, status=3)


@pytest.mark.parametrize("name", sorted(WITHOUT_COUNTER))
def test_format_without_counter_reports_undetectable_loss(name: str, tmp_path: Path) -> None:
    log = EVERY_FORMAT[name](tmp_path)
    if name == "openpilot":
        (log / "rlog.bz2").write_bytes(bz2.compress(b"".join(drive_messages(24)[:-1])))
    else:
        file = log if log.is_file() else next(log.glob("*_car.csv"))
        lines = file.read_bytes().splitlines(keepends=True)
        middle = next(k for k in range(len(lines) // 2, len(lines)) if b"Statistic" not in lines[k])
        del lines[middle]
        file.write_bytes(b"".join(lines))

    ledger = read(log)[1]

    assert ledger.is_whole
    assert "cannot be detected" in ledger.integrity
    (row,) = (line for line in DOCS.read_text().splitlines() if "no usable count" in line)
    assert WITHOUT_COUNTER[name] in row.partition("no usable count")[0]


def test_row_counted_only_in_metadata_is_reported_as_dropped(tmp_path: Path) -> None:
    log = EVERY_FORMAT["rosbag2"](tmp_path)
    text = (log / "metadata.yaml").read_text()
    shutil.copy(log / "metadata.yaml", tmp_path)
    head, mark, rest = text.rpartition("message_count: ")
    digits = rest[: len(rest) - len(rest.lstrip("0123456789"))]
    more = f"{head}{mark}{int(digits) + 1}{rest[len(digits) :]}"
    (log / "metadata.yaml").write_text(more)

    _, ledger = read(log)

    assert [account.dropped.total() for account in ledger.accounts.values() if account.dropped] == [
        1
    ]
