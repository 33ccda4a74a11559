"""PEAK TRC logs: versions, start times, and lines off the common pattern."""

from __future__ import annotations

from pathlib import Path

import can
import pytest

from crosscue.replay.columns import DATA, ERROR, REMOTE
from crosscue.replay.errors import LogFormatError
from crosscue.replay.log import open_log
from support.can_files import Sent, read_back, same_as_python_can
from support.data import shared

V1 = ";$FILEVERSION=1.1\n;$STARTTIME=25569.5\n"
V2 = ";$FILEVERSION=2.1\n;$STARTTIME=25569.5\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n"
NOON_NS = 43_200_000_000_000
LINE_1 = "     1)      1.6  Rx         0480  2  C2 08 \n"
LINE_2 = "      1      1.600 DT 1      0300 Rx -  2    C2 08\n"


def _log(folder: Path, text: str) -> Path:
    path = folder / "x.trc"
    path.write_text(text, encoding="latin-1")
    return path


T_NS = NOON_NS + 1_600_000


@pytest.mark.parametrize(
    ("text", "frame"),
    [
        (V1 + LINE_1, Sent(T_NS, "can/1", 0x480, b"\xc2\x08")),
        (V1 + LINE_1.replace("0480", "00000480"), Sent(T_NS, "can/1", 0x480, b"\xc2\x08", True)),
        (V1 + " 1) 1.6 Tx 0480 3 RTR\n", Sent(T_NS, "can/1", 0x480, b"", False, REMOTE)),
        (V1 + " 1) 1.6 Error 0008 2 02 00\n", Sent(T_NS, "can/1", 8, b"\2\0", False, ERROR)),
        (V1 + " 1) 1,6 Rx 0480 0\n", Sent(T_NS, "can/1", 0x480, b"")),
        (V2 + LINE_2, Sent(T_NS, "can/1", 0x300, b"\xc2\x08")),
        (V2 + " 1 1.6 RR 3 0300 Rx - 4\n", Sent(T_NS, "can/3", 0x300, b"", False, REMOTE)),
        (V2 + " 1 1.6 ER 1 - Rx - 2 04 00\n", Sent(T_NS, "can/1", 0, b"\4\0", False, ERROR)),
        (V2 + " 1 1.6 FB 1 0300 Rx - 9 " + "AB " * 12 + "\n",
         Sent(T_NS, "can/1", 0x300, b"\xab" * 12, False, DATA, True)),
        (V2.replace("R,L,D", "l,D") + " 1 1.6 FD 1 0300 Rx 12 " + "AB " * 12 + "\n",
         Sent(T_NS, "can/1", 0x300, b"\xab" * 12, False, DATA, True)),
        ("; no version\n 1)  1  0480 2 C2 08\n", Sent(1_000_000, "can/1", 0x480, b"\xc2\x08")),
    ],
)  # fmt: skip
def test_a_line_says_what_it_says(tmp_path: Path, text: str, frame: Sent) -> None:
    found, ledger = read_back(_log(tmp_path, text))

    assert found == {frame.bus: [frame]}
    assert ledger.is_whole


@pytest.mark.parametrize(
    "line",
    [
        " 1) 1.6 Rx 0480 3 C2 08",
        " 1) 1.6 Rx 0480 1 C2 08",
        " 1) 1.6 Rx 0480 2 C2 0",
        " 1) 1.6 Rx 0480 2 C2 0G",
        " 1) 1.6 Rx 0480 2 C2  08 77",
        " 1) 1.6 Rx 0800 2 C2 08",
        " 1) 1.6 Qx 0480 2 C2 08",
        " 1) nan Rx 0480 2 C2 08",
        " 1) -1.6 Rx 0480 2 C2 08",
        " 1  1.6 Rx 0480 2 C2 08",
        " x) 1.6 Rx 0480 2 C2 08",
        "gibberish",
    ],
)
def test_a_line_that_can_be_no_frame_is_lost_and_told(tmp_path: Path, line: str) -> None:
    found, ledger = read_back(_log(tmp_path, V1 + LINE_1 + line + "\n" + LINE_1))

    assert len(found["can/1"]) == 2
    assert ledger.topic("").dropped.total() == 1
    assert "line 4" in next(ledger.drops()).detail


@pytest.mark.parametrize(
    "line", [" 1) 1.6 Warng FFFFFFFF 4 00 00 00 08 BUSHEAVY", " 1) 1.6 ErrCt 0000 2 00 00"]
)
def test_status_lines_are_counted_as_no_frames(tmp_path: Path, line: str) -> None:
    found, ledger = read_back(_log(tmp_path, V1 + LINE_1 + line + "\n"))

    assert len(found["can/1"]) == 1
    assert ledger.topic("").skipped == {"status line, no frame": 1}


@pytest.mark.parametrize(
    ("days", "t_ns"),
    [
        ("25569", 0),
        ("25569.25", 21_600_000_000_000),
        ("25569.0000000001", 8_640),
        ("25569.00000000000001", 1),
        ("45332.7893418634", 1_707_591_399_136_997_760),
    ],
)
def test_start_times_are_exact(tmp_path: Path, days: str, t_ns: int) -> None:
    text = V1.replace("25569.5", days) + LINE_1.replace("1.6", "0.0")

    found, _ = read_back(_log(tmp_path, text))

    assert found["can/1"][0].t_ns == t_ns


def test_without_a_start_time_times_count_from_zero_and_it_is_said(tmp_path: Path) -> None:
    found, ledger = read_back(_log(tmp_path, ";$FILEVERSION=1.1\n" + LINE_1))

    assert found["can/1"][0].t_ns == 1_600_000
    assert any("no $STARTTIME" in notice for notice in ledger.notices)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (";$FILEVERSION=3.0\n" + LINE_1, "version 3.0 unknown"),
        (";$FILEVERSION=2.1\n" + LINE_2, "columns 'missing'"),
        (V2.replace("N,O", "N,N") + LINE_2, "header is damaged"),
        (V2.replace("L,D", "D,L") + LINE_2, "header is damaged"),
        ("once upon a time\n", "no frame of a PEAK TRC log"),
    ],
)
def test_a_header_that_cannot_be_followed_is_refused(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(LogFormatError, match=says):
        open_log(_log(tmp_path, text))


def test_another_version_in_the_middle_ends_the_reading(tmp_path: Path) -> None:
    found, ledger = read_back(_log(tmp_path, V1 + LINE_1 + V2 + LINE_2))

    assert len(found["can/1"]) == 1
    assert ledger.topic("").dropped_unknown == ["another version begins inside the file"]


def test_two_logs_in_one_file_keep_their_start_times(tmp_path: Path) -> None:
    text = V1 + LINE_1 + V1.replace("25569", "25570") + LINE_1

    found, ledger = read_back(_log(tmp_path, text))

    assert [f.t_ns - T_NS for f in found["can/1"]] == [0, 86_400_000_000_000]
    assert ledger.is_whole


@pytest.mark.parametrize("name", ["happy.trc", "passat-idling.trc", "test_motorola.trc"])
def test_real_logs_read_as_python_can_reads_them(name: str) -> None:
    path = shared("can", "rusefi_trc", name)

    # It rounds the start time to microseconds.
    same_as_python_can(path, can.TRCReader(path), "can/{}", within_ns=800)
