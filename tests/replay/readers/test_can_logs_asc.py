"""Vector ASC logs: headers, times, and unusual lines."""

from __future__ import annotations

import time
from pathlib import Path

import can
import pytest

from crosscue.replay.columns import DATA, ERROR, REMOTE
from support.can_files import Sent, assert_equal_to_python_can, read_back
from support.data import shared

HEAD = "date Fri Jul 10 12:00:00.000 pm 2015\nbase hex  timestamps absolute\n"
NOON_NS = 1_436_529_600_000_000_000
LINE = "   0.5 1  64  Rx   d 2 64 00\n"


def _log(folder: Path, text: str, encoding: str = "utf-8") -> Path:
    path = folder / "x.asc"
    path.write_bytes(text.encode(encoding))
    return path


def _at(seconds: float) -> int:
    return NOON_NS + int(seconds * 1e9)


HALF = _at(0.5)
FD_FRAME = Sent(HALF, "can/2", 0x300, b"\1\2", False, DATA, True)


@pytest.mark.parametrize(
    ("line", "frame"),
    [
        ("1  64 Rx d 1 0A", Sent(HALF, "can/1", 0x64, b"\n")),
        ("1  64 Tx d 0", Sent(HALF, "can/1", 0x64, b"")),
        ("1  64x Rx d 1 0A", Sent(HALF, "can/1", 0x64, b"\n", True)),
        ("1  64 Rx d 9 01 02 03 04 05 06 07 08", Sent(HALF, "can/1", 0x64, bytes(range(1, 9)))),
        ("1  64 Rx d 1 0A  Length = 0 BitCount = 0 ID = 100", Sent(HALF, "can/1", 0x64, b"\n")),
        ("1  64 Rx r", Sent(HALF, "can/1", 0x64, b"", False, REMOTE)),
        ("1  64 Rx r 8 Length = 1704000", Sent(HALF, "can/1", 0x64, b"", False, REMOTE)),
        ("12 ErrorFrame Flags = 0xe", Sent(HALF, "can/12", 0, b"", False, ERROR)),
        ("Powertrain 64 Rx d 1 0A", Sent(HALF, "Powertrain", 0x64, b"\n")),
        ("Some_really_long_name 64 Rx d 1 0A", Sent(HALF, "Some_really_long_name", 0x64, b"\n")),
        ("CANFD 2 Tx 300 1 0 2 2 01 02 10 20 303000 0", FD_FRAME),
        ("CANFD 2 Rx 300 Name 1 0 2 2 01 02 10 20 303000 0", FD_FRAME),
        ("CANFD 5 Tx ErrorFrame Not Acknowledge", Sent(HALF, "can/5", 0, b"", False, ERROR, True)),
    ],
)
def test_valid_line_is_read_as_expected_frame(tmp_path: Path, line: str, frame: Sent) -> None:
    for mark in ".,":
        found, ledger = read_back(_log(tmp_path, f"{HEAD}   0{mark}5 {line}\n"))

        assert found == {frame.bus: [frame]}
        assert ledger.is_whole


@pytest.mark.parametrize(
    "line",
    [
        "0.5 1  64 Rx d 8 0A",
        "0.5 1  64 Rx d 1 0A 0B",
        "0.5 1  64 Rx d 1 A",
        "0.5 1  64 Rx d 1 0G",
        "0.5 1  64 Rx d 1 0AB",
        "0.5 1  800 Rx d 1 0A",
        "0.5 1  20000000x Rx d 1 0A",
        "0.5 1  64 Rx q 1 0A",
        "nan 1  64 Rx d 1 0A",
        "-0.5 1  64 Rx d 1 0A",
        "9223372036.9 1  64 Rx d 1 0A",
        "0.5 CANFD 2 Tx 300 1 0 9 8 01 02 03 04 05 06 07 08",
        "0.5 CANFD 2 Tx 300 1 0 2 2 01",
        "0.5 1  Bogus event",
        "gibberish",
    ],
)
def test_invalid_line_is_dropped_and_reported(tmp_path: Path, line: str) -> None:
    found, ledger = read_back(_log(tmp_path, HEAD + LINE + line + "\n" + LINE))

    assert len(found["can/1"]) == 2
    assert ledger.topic("").dropped.total() == 1
    assert "line 4" in next(ledger.drops()).detail


def test_decimal_logs_are_read_as_decimal(tmp_path: Path) -> None:
    text = HEAD.replace("hex", "dec") + "0.5 1  100 Rx d 3 100 0 255\n0.6 1  100 Rx d 1 256\n"

    found, ledger = read_back(_log(tmp_path, text))

    assert found["can/1"] == [Sent(_at(0.5), "can/1", 100, b"d\0\xff")]
    assert ledger.topic("").dropped.total() == 1


@pytest.mark.parametrize(
    ("date", "seconds"),
    [
        ("Fri Jul 10 12:00:00.000 pm 2015", 0),
        ("Fri Jul 10 12:00:00 2015", 0),
        ("Fre Jul 10 11:00:00,250 2015", -3599.75),
        ("Jul 10 11:00:01.5 am 2015", -3598.5),
        ("Mit Mär 10 12:00:00 2010", -168_307_200),
        ("Fri Okt 9 12:00:00 2015", 7_862_400),
    ],
)
def test_dates_are_read_as_utc_in_every_time_zone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, date: str, seconds: float
) -> None:
    text = f"date {date}\nbase hex  timestamps absolute\n" + LINE.replace("0.5", "0.0")
    path = _log(tmp_path, text, "latin-1")
    for zone in ("UTC", "America/Los_Angeles"):
        monkeypatch.setenv("TZ", zone)
        time.tzset()

        found, ledger = read_back(path)

        assert found["can/1"][0].t_ns == _at(seconds)
        assert any("no time zone" in notice for notice in ledger.notices)
    monkeypatch.undo()
    time.tzset()


@pytest.mark.parametrize("name", ["issue_1256.asc", "logfile.asc"])
def test_real_logs_match_python_can(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    path = shared("can", "python_can", name)
    monkeypatch.setenv("TZ", "UTC")
    time.tzset()
    peer = list(can.ASCReader(path, relative_timestamp=False))
    monkeypatch.undo()
    time.tzset()
    for message in peer:
        assert isinstance(message.channel, int)
        message.channel += 1

    assert_equal_to_python_can(path, peer, "can/{}")
