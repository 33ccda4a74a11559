"""Text logs."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Final

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.columns import DATA, ERROR, REMOTE, Table
from crosscue.replay.errors import LogFormatError
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
from crosscue.replay.readers.can_text.dialect import NOT_UNDERSTOOD
from crosscue.replay.readers.can_text.lines import Lines, Tail, read_lines
from crosscue.replay.readers.can_text.trc import GO_BACK, MISFIT, MISSING
from crosscue.replay.readers.text_log import MAX_LINE, Row, TextLog
from support.can_files import Sent, assert_equal_to_python_can, random_frames, read_back, trc
from support.data import shared
from support.trees import written

ASC_HEAD: Final = "date Fri Jul 10 12:00:00.000 pm 2015\nbase hex  timestamps absolute\n"
TRC_V1: Final = ";$FILEVERSION=1.1\n;$STARTTIME=25569.5\n"
TRC_V2: Final = ";$FILEVERSION=2.1\n;$STARTTIME=25569.5\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n"
ROW_V1: Final = "     1)      1.6  Rx         0480  2  C2 08 \n"
ROW_V2: Final = "      1      1.600 DT 1      0300 Rx -  2    C2 08\n"
# For each dialect, its header and a valid line.
VALID: Final = {
    "asc": (ASC_HEAD, "   0.5 1  64  Rx   d 2 64 00\n"),
    "log": ("", "(1.000000) can0 123#DEADBEEF\n"),
    "trc": (TRC_V1, ROW_V1),
}
NOON_NS: Final = 1_436_529_600_000_000_000
HALF: Final = NOON_NS + 500_000_000
# Half past one second, in a candump log; and the time of the rows above, in a TRC log.
S15: Final = 1_500_000_000
T16: Final = 43_200_000_000_000 + 1_600_000
FD_FRAME: Final = Sent(HALF, "can/2", 0x300, b"\1\2", False, DATA, True)
TWELVE: Final = "AB " * 12 + "\n"
LONG: Final = Sent(T16, "can/1", 0x300, b"\xab" * 12, False, DATA, True)


def write_log(folder: Path, dialect: str, text: str | bytes, encoding: str = "latin-1") -> Path:
    path = folder / f"x.{dialect}"
    path.write_bytes(text.encode(encoding) if isinstance(text, str) else text)
    return path


@pytest.mark.parametrize(
    ("text", "frame"),
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
        ("CANFD 2 Tx 300 1 0 2 2 01 02 10 20 303000 0", FD_FRAME),
        ("CANFD 2 Rx 300 Name 1 0 2 2 01 02 10 20 303000 0", FD_FRAME),
        ("CANFD 5 Tx ErrorFrame Not Acknowledge", Sent(HALF, "can/5", 0, b"", False, ERROR, True)),
        ("(1.5) can0 123#", Sent(S15, "can0", 0x123, b"")),
        ("(1.500000001) can0 123#AA", Sent(S15 + 1, "can0", 0x123, b"\xaa")),
        ("(0001.5) a 7FF#aa R", Sent(S15, "a", 0x7FF, b"\xaa")),
        ("(1.5) can0 00000123#AA T", Sent(S15, "can0", 0x123, b"\xaa", True)),
        ("(1.5) can0 123#R", Sent(S15, "can0", 0x123, b"", False, REMOTE)),
        ("(1.5) can0 123#R8 R", Sent(S15, "can0", 0x123, b"", False, REMOTE)),
        ("(1.5) can0 20000088#0001", Sent(S15, "can0", 0x88, b"\0\1", False, ERROR)),
        ("(1.5) can0 123##3", Sent(S15, "can0", 0x123, b"", False, DATA, True)),
        ("(1.5) can0 123#1122334455667788_E", Sent(S15, "can0", 0x123, b'\x11"3DUfw\x88')),
        (" (1.5)  can0  123   [2]  0A 0B", Sent(S15, "can0", 0x123, b"\n\x0b")),
        (" (1.5) can0 123  [0]  remote request", Sent(S15, "can0", 0x123, b"", False, REMOTE)),
        ("(1.5) 0 123#AA\r", Sent(S15, "can/0", 0x123, b"\xaa")),
        (TRC_V1 + ROW_V1, Sent(T16, "can/1", 0x480, b"\xc2\x08")),
        (TRC_V1 + ROW_V1.replace("04", "000004"), Sent(T16, "can/1", 0x480, b"\xc2\x08", True)),
        (TRC_V1 + " 1) 1.6 Tx 0480 3 RTR\n", Sent(T16, "can/1", 0x480, b"", False, REMOTE)),
        (TRC_V1 + " 1) 1.6 Error 0008 2 02 00\n", Sent(T16, "can/1", 8, b"\2\0", False, ERROR)),
        (TRC_V1 + " 1) 1,6 Rx 0480 0\n", Sent(T16, "can/1", 0x480, b"")),
        (TRC_V2 + ROW_V2, Sent(T16, "can/1", 0x300, b"\xc2\x08")),
        (TRC_V2 + " 1 1.6 RR 3 0300 Rx - 4\n", Sent(T16, "can/3", 0x300, b"", False, REMOTE)),
        (TRC_V2 + " 1 1.6 ER 1 - Rx - 2 04 00\n", Sent(T16, "can/1", 0, b"\4\0", False, ERROR)),
        (TRC_V2 + " 1 1.6 FB 1 0300 Rx - 9 " + TWELVE, LONG),
        (TRC_V2.replace("R,L,D", "l,D") + " 1 1.6 FD 1 0300 Rx 12 " + TWELVE, LONG),
        ("; no version\n 1)  1  0480 2 C2 08\n", Sent(1_000_000, "can/1", 0x480, b"\xc2\x08")),
    ],
)
def test_line_is_read_as_frame(tmp_path: Path, text: str, frame: Sent) -> None:
    dialect = "trc" if text.startswith(";") else "log" if "(" in text else "asc"
    heads = [f"{ASC_HEAD}   0{mark}5 " for mark in ".,"] if dialect == "asc" else [""]
    for head in heads:
        found, ledger = read_back(write_log(tmp_path, dialect, f"{head}{text}\n"))

        assert found == {frame.bus: [frame]}
        assert ledger.is_whole


@pytest.mark.parametrize(
    ("dialect", "line"),
    [
        ("asc", "0.5 1  64 Rx d 8 0A"),
        ("asc", "0.5 1  64 Rx d 1 0A 0B"),
        ("asc", "0.5 1  64 Rx d 1 A"),
        ("asc", "0.5 1  64 Rx d 1 0G"),
        ("asc", "0.5 1  800 Rx d 1 0A"),
        ("asc", "0.5 1  20000000x Rx d 1 0A"),
        ("asc", "0.5 1  64 Rx q 1 0A"),
        ("asc", "nan 1  64 Rx d 1 0A"),
        ("asc", "-0.5 1  64 Rx d 1 0A"),
        ("asc", "9223372036.9 1  64 Rx d 1 0A"),
        ("asc", "0.5 CANFD 2 Tx 300 1 0 9 8 01 02 03 04 05 06 07 08"),
        ("asc", "0.5 CANFD 2 Tx 300 1 0 2 2 01"),
        ("asc", "0.5 1  Bogus event"),
        ("asc", "gibberish"),
        ("log", "(nan) can0 123#AA"),
        ("log", "(-1.0) can0 123#AA"),
        ("log", "(99999999999.0) can0 123#AA"),
        ("log", "(9223372036.9) can0 123#AA"),
        ("log", "(1.0) can0 123#AAB"),
        ("log", "(1.0) can0 123#AG"),
        ("log", "(1.0) can0 FFF#AA"),
        ("log", "(1.0) can0 40000000#AA"),
        ("log", "(1.0) can0 1234#AA"),
        ("log", "(1.0) can0 123#112233445566778899"),
        ("log", "(1.0) can0 123##1112233445566778899"),
        ("log", "(1.0) can0 123##G11"),
        ("log", "(1.0) can0 123 AA"),
        ("log", "(1.0) c\x01n0 123#AA"),
        ("log", "(1.0)  123#AA"),
        ("log", "(1.0) can0 123#AA X"),
        ("log", "(1.0 can0 123#AA"),
        ("log", " (1.5)  can0  123   [3]  0A 0B"),
        ("log", "(1.0) can0 123#" + "A" * 20_000),
        ("trc", " 1) 1.6 Rx 0480 3 C2 08"),
        ("trc", " 1) 1.6 Rx 0480 1 C2 08"),
        ("trc", " 1) 1.6 Rx 0480 2 C2 0"),
        ("trc", " 1) 1.6 Rx 0480 2 C2 0G"),
        ("trc", " 1) 1.6 Rx 0480 2 C2  08 77"),
        ("trc", " 1) 1.6 Rx 0800 2 C2 08"),
        ("trc", " 1) 1.6 Qx 0480 2 C2 08"),
        ("trc", " 1) nan Rx 0480 2 C2 08"),
        ("trc", " 1) -1.6 Rx 0480 2 C2 08"),
        ("trc", " 1  1.6 Rx 0480 2 C2 08"),
        ("trc", " x) 1.6 Rx 0480 2 C2 08"),
        ("trc", "gibberish"),
    ],
)
def test_invalid_line_is_dropped_with_its_number(tmp_path: Path, dialect: str, line: str) -> None:
    head, valid = VALID[dialect]

    found, ledger = read_back(write_log(tmp_path, dialect, f"{head}{valid}{line}\n{valid}"))

    assert [len(frames) for frames in found.values()] == [2]
    assert ledger.topic("").dropped.total() == 1
    assert f"line {head.count(chr(10)) + 2}" in next(ledger.drops()).detail


@pytest.mark.parametrize(
    ("dialect", "content", "match"),
    [
        ("log", b"", "empty"),
        ("log", b"\x1f\x8b\x08abc", "gzip"),
        ("log", "(1.0) can0 1#\n".encode("utf-16"), "UTF-16"),
        ("log", b"  can0  123   [8]  00 11 22 33 44 55 66 77\n", "without times"),
        ("log", b" (2015-07-10 06:17:32.249713)  can0  123   [1]  DE\n", "time zone"),
        ("log", b"hello\nworld\n", "no frame of a candump log"),
        ("log", bytes(200_000), "without a line end"),
        ("trc", ";$FILEVERSION=3.0\n" + ROW_V1, "version 3.0 unknown"),
        ("trc", ";$FILEVERSION=2.1\n" + ROW_V2, "columns 'missing'"),
        ("trc", TRC_V2.replace("N,O", "N,N") + ROW_V2, "header is damaged"),
        ("trc", TRC_V2.replace("L,D", "D,L") + ROW_V2, "header is damaged"),
        ("trc", "once upon a time\n", "no frame of a PEAK TRC log"),
    ],
)
def test_unsupported_file_is_refused_in_one_line(
    tmp_path: Path, dialect: str, content: str | bytes, match: str
) -> None:
    with pytest.raises(LogFormatError, match=match) as refused:
        open_log(write_log(tmp_path, dialect, content))
    assert "\n" not in str(refused.value)


def test_decimal_asc_log_is_read_as_decimal(tmp_path: Path) -> None:
    text = ASC_HEAD.replace("hex", "dec") + "0.5 1  100 Rx d 3 100 0 255\n0.6 1  100 Rx d 1 256\n"

    found, ledger = read_back(write_log(tmp_path, "asc", text))

    assert found["can/1"] == [Sent(HALF, "can/1", 100, b"d\0\xff")]
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
    text = f"date {date}\nbase hex  timestamps absolute\n   0.0 1  64  Rx   d 2 64 00\n"
    path = write_log(tmp_path, "asc", text)
    for zone in ("UTC", "America/Los_Angeles"):
        monkeypatch.setenv("TZ", zone)
        time.tzset()

        found, ledger = read_back(path)

        assert found["can/1"][0].t_ns == NOON_NS + int(seconds * 1e9)
        assert any("no time zone" in notice for notice in ledger.notices)
    monkeypatch.undo()
    time.tzset()


def test_zeroed_span_drops_only_affected_lines(tmp_path: Path) -> None:
    text = VALID["log"][1] * 10 + "\0" * 3_000_000 + "\n" + VALID["log"][1] * 10

    found, ledger = read_back(write_log(tmp_path, "log", text))

    assert len(found["can0"]) == 20
    assert not ledger.is_whole


def test_frames_beyond_bus_limit_are_dropped(tmp_path: Path) -> None:
    text = "".join(f"(1.0) can{k} 123#AA\n" for k in range(1000))

    found, ledger = read_back(write_log(tmp_path, "log", text))

    assert len(found) == 256
    assert ledger.topic("").dropped == {"more buses than a log can have": 744}


@pytest.mark.parametrize("size", [64, 100, 1000])
def test_lines_are_complete_for_any_chunk_size(tmp_path: Path, size: int) -> None:
    lines = [b"x" * (k % 29) for k in range(300)]
    path = write_log(tmp_path, "log", b"\n".join(lines) + b"\r\nlast")
    got: list[bytes] = []
    for piece in read_lines(path, size):
        if isinstance(piece, Lines):
            assert piece.first_number == len(got) + 1
            got += [piece.text(i) for i in range(piece.done)]
        else:
            assert isinstance(piece, Tail)
            got.append(piece.text)
    assert got == [*lines, b"last"]


@pytest.mark.parametrize("name", ["issue_1256.asc", "logfile.asc"])
def test_real_asc_logs_match_python_can(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    path = shared("can", "python_can", name)
    monkeypatch.setenv("TZ", "UTC")
    time.tzset()
    peer = list(can.ASCReader(path, relative_timestamp=False))
    monkeypatch.undo()
    time.tzset()
    for message in peer:
        assert isinstance(message.channel, int)
        message.channel += 1

    assert_equal_to_python_can(path, peer)


@pytest.mark.parametrize(
    ("name", "missing"),
    [
        ("passat-idling.trc", 0),
        # Filtered after the recording; happy.trc consists of two such logs.
        ("happy.trc", 11_458),
        ("test_motorola.trc", 99_976 - 2_863),
    ],
)
def test_real_trc_logs_match_python_can(name: str, missing: int) -> None:
    path = shared("can", "rusefi_trc", name)

    # python-can rounds the start time to microseconds.
    assert_equal_to_python_can(path, can.TRCReader(path), within_ns=800, missing=missing)


@pytest.mark.parametrize("version", ["1.0", "1.1", "1.2", "1.3", "2.1"])
@given(deleted=st.sets(st.integers(0, 59)))
@settings(max_examples=25)
def test_every_deleted_row_of_trc_log_is_reported_as_dropped(
    tmp_path: Path, version: str, deleted: set[int]
) -> None:
    frames = random_frames(60, fd=version > "2")
    if version < "1.2":
        frames = [replace(f, bus="1") for f in frames]
    lines = trc(frames, version).splitlines(keepends=True)
    head, rows = lines[:-60], lines[-60:]
    kept = [k for k in range(60) if k not in deleted]
    # Rows deleted at the end cannot be detected.
    missing = sum(k < max(kept, default=-1) for k in deleted)
    text = b"".join([*head, *(rows[k] for k in kept)])

    found, ledger = read_back(write_log(tmp_path, "trc", text))

    assert sum(map(len, found.values())) == len(kept)
    assert ledger.topic("").dropped == ({MISSING: missing} if missing else {})
    assert ledger.is_whole == (not missing)


def numbered(*numbers: int, head: str = TRC_V1) -> str:
    rows = (f"{n:>6}) {k}.5  Rx  0480  2  C2 08\n" for k, n in enumerate(numbers))
    return head + "".join(rows)


MISREAD: Final = "gibberish\n"
MAYBE_CUT: Final = "file may be cut after its last frame"


@pytest.mark.parametrize(
    ("text", "dropped", "unknown", "rows"),
    [
        (numbered(1, 3, 2, 4), {}, [], 4),
        (numbered(0, 1, 2), {}, [], 3),
        (numbered(3, 4), {MISSING: 2}, [], 2),
        (numbered(1, 2, 2, 3), {}, [GO_BACK], 4),
        (numbered(1, 2, 3, 1, 2, 4), {MISSING: 1}, [GO_BACK], 6),
        (numbered(1, 2, 5, 6, 2, 3, 4), {MISSING: 2}, [GO_BACK], 7),
        (numbered(1, 2, 9, 4, 5), {MISFIT: 1}, [], 4),
        (numbered(1, 2, 900_003, 4, 5), {MISFIT: 1}, [], 4),
        (numbered(1, 2) + numbered(1, 3), {MISSING: 1}, [], 4),
        (numbered(1) + MISREAD + numbered(3, head=""), {NOT_UNDERSTOOD: 1}, [], 2),
        (numbered(1) + MISREAD + numbered(4, head=""), {NOT_UNDERSTOOD: 1, MISSING: 1}, [], 2),
        (numbered(1) + MISREAD + numbered(2, 4, head=""), {NOT_UNDERSTOOD: 1, MISSING: 1}, [], 3),
        (numbered(1, 2) + " 5) 9.0 Warng FFFFFFFF 4 00 00 00 08 BUSHEAVY\n", {MISSING: 2}, [], 2),
        (numbered(1, 2) + " 5) 9.0 Rx 0480 1 C2", {MISSING: 2}, [MAYBE_CUT], 3),
    ],
)
def test_message_numbers_that_are_not_consecutive_are_reported(
    tmp_path: Path, text: str, dropped: dict[str, int], unknown: list[str], rows: int
) -> None:
    found, ledger = read_back(write_log(tmp_path, "trc", text))

    assert sum(map(len, found.values())) == rows
    assert ledger.topic("").dropped == dropped
    assert ledger.topic("").dropped_unknown == unknown


def row_of(line: str) -> Row:
    t_ns, *values = line.split()
    return int(t_ns), *map(float, values)


@pytest.mark.parametrize(
    "line",
    ["not a number", "5 1.0", "5 1.0 2.0 3.0", f"{1 << 64} 1.0 2.0", "5 1.0 " + "2" * MAX_LINE],
)
def test_invalid_line_is_dropped_and_others_are_read(line: str, tmp_path: Path) -> None:
    path = written(tmp_path / "log.txt", f"1 2.0 3.0\n{line}\n9 4.0 5.0\n")
    ledger = Ledger("log.txt")

    (block,) = TextLog(path, "text", "/rows", ["x_m", "y_m"], row_of).read(ledger)

    assert block.log_ns.tolist() == [1, 9]
    assert isinstance(block.rows, Table)
    assert {name: block.rows.columns[name].tolist() for name in block.rows.columns} == {
        "x_m": [2.0, 4.0],
        "y_m": [3.0, 5.0],
    }
    assert block.rows.columns["x_m"].dtype == np.float64
    account = ledger.topic("/rows")
    assert (account.found, sum(account.dropped.values())) == (2, 1)
