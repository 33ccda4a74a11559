"""PEAK TRC logs: versions, start times, and unusual lines."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.columns import DATA, ERROR, REMOTE
from crosscue.replay.errors import LogFormatError
from crosscue.replay.logs.opening import open_log
from crosscue.replay.readers.can_text.message_numbers import GO_BACK, MISFIT, MISSING
from crosscue.replay.readers.can_text.trc import NOT_UNDERSTOOD
from support.can_files import Sent, assert_equal_to_python_can, random_frames, read_back, trc
from support.data import shared

HEAD_V1 = ";$FILEVERSION=1.1\n;$STARTTIME=25569.5\n"
HEAD_V2 = ";$FILEVERSION=2.1\n;$STARTTIME=25569.5\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n"
NOON_NS = 43_200_000_000_000
LINE_V1 = "     1)      1.6  Rx         0480  2  C2 08 \n"
LINE_V2 = "      1      1.600 DT 1      0300 Rx -  2    C2 08\n"


def _log(folder: Path, text: str) -> Path:
    path = folder / "x.trc"
    path.write_text(text, encoding="latin-1")
    return path


T_NS = NOON_NS + 1_600_000


@pytest.mark.parametrize(
    ("text", "frame"),
    [
        (HEAD_V1 + LINE_V1, Sent(T_NS, "can/1", 0x480, b"\xc2\x08")),
        (
            HEAD_V1 + LINE_V1.replace("0480", "00000480"),
            Sent(T_NS, "can/1", 0x480, b"\xc2\x08", True),
        ),
        (HEAD_V1 + " 1) 1.6 Tx 0480 3 RTR\n", Sent(T_NS, "can/1", 0x480, b"", False, REMOTE)),
        (HEAD_V1 + " 1) 1.6 Error 0008 2 02 00\n", Sent(T_NS, "can/1", 8, b"\2\0", False, ERROR)),
        (HEAD_V1 + " 1) 1,6 Rx 0480 0\n", Sent(T_NS, "can/1", 0x480, b"")),
        (HEAD_V2 + LINE_V2, Sent(T_NS, "can/1", 0x300, b"\xc2\x08")),
        (HEAD_V2 + " 1 1.6 RR 3 0300 Rx - 4\n", Sent(T_NS, "can/3", 0x300, b"", False, REMOTE)),
        (HEAD_V2 + " 1 1.6 ER 1 - Rx - 2 04 00\n", Sent(T_NS, "can/1", 0, b"\4\0", False, ERROR)),
        (
            HEAD_V2 + " 1 1.6 FB 1 0300 Rx - 9 " + "AB " * 12 + "\n",
            Sent(T_NS, "can/1", 0x300, b"\xab" * 12, False, DATA, True),
        ),
        (
            HEAD_V2.replace("R,L,D", "l,D") + " 1 1.6 FD 1 0300 Rx 12 " + "AB " * 12 + "\n",
            Sent(T_NS, "can/1", 0x300, b"\xab" * 12, False, DATA, True),
        ),
        ("; no version\n 1)  1  0480 2 C2 08\n", Sent(1_000_000, "can/1", 0x480, b"\xc2\x08")),
    ],
)
def test_valid_line_is_read_as_expected_frame(tmp_path: Path, text: str, frame: Sent) -> None:
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
def test_invalid_line_is_dropped_and_reported(tmp_path: Path, line: str) -> None:
    found, ledger = read_back(_log(tmp_path, HEAD_V1 + LINE_V1 + line + "\n" + LINE_V1))

    assert len(found["can/1"]) == 2
    assert ledger.topic("").dropped.total() == 1
    assert "line 4" in next(ledger.drops()).detail


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
    text = HEAD_V1.replace("25569.5", days) + LINE_V1.replace("1.6", "0.0")

    found, _ = read_back(_log(tmp_path, text))

    assert found["can/1"][0].t_ns == t_ns


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (";$FILEVERSION=3.0\n" + LINE_V1, "version 3.0 unknown"),
        (";$FILEVERSION=2.1\n" + LINE_V2, "columns 'missing'"),
        (HEAD_V2.replace("N,O", "N,N") + LINE_V2, "header is damaged"),
        (HEAD_V2.replace("L,D", "D,L") + LINE_V2, "header is damaged"),
        ("once upon a time\n", "no frame of a PEAK TRC log"),
    ],
)
def test_unsupported_or_damaged_header_is_refused(tmp_path: Path, text: str, match: str) -> None:
    with pytest.raises(LogFormatError, match=match):
        open_log(_log(tmp_path, text))


@pytest.mark.parametrize(
    ("name", "missing"),
    [
        ("passat-idling.trc", 0),
        # Filtered after the recording; happy.trc consists of two such logs.
        ("happy.trc", 11_458),
        ("test_motorola.trc", 99_976 - 2_863),
    ],
)
def test_real_logs_match_python_can(name: str, missing: int) -> None:
    path = shared("can", "rusefi_trc", name)

    # python-can rounds the start time to microseconds.
    assert_equal_to_python_can(path, can.TRCReader(path), "can/{}", within_ns=800, missing=missing)


@dataclass(frozen=True)
class LogWithGaps:
    """A log with some of its rows deleted, and the number of detectable deletions."""

    text: str
    missing: int


def _log_without(version: str, count: int, deleted: set[int]) -> LogWithGaps:
    """Return a log of ``count`` rows without those at ``deleted``.

    Deleted rows at the end of the log cannot be detected and are not counted.
    """
    is_old = version < "1.2"
    frames = [replace(f, bus="1") if is_old else f for f in random_frames(count, fd=version > "2")]
    lines = trc(frames, version).decode().splitlines(keepends=True)
    head, rows = lines[:-count], lines[-count:]
    kept = [k for k in range(count) if k not in deleted]
    last = kept[-1] if kept else -1
    text = "".join([*head, *(rows[k] for k in kept)])
    return LogWithGaps(text, sum(k < last for k in deleted))


@pytest.mark.parametrize("version", ["1.0", "1.1", "1.2", "1.3", "2.1"])
@given(deleted=st.sets(st.integers(0, 59)))
@settings(max_examples=25, deadline=None)
def test_every_deleted_row_is_reported_as_dropped(
    tmp_path_factory: pytest.TempPathFactory, version: str, deleted: set[int]
) -> None:
    log = _log_without(version, 60, deleted)

    found, ledger = read_back(_log(tmp_path_factory.mktemp("log"), log.text))

    assert sum(map(len, found.values())) == 60 - len(deleted)
    assert ledger.topic("").dropped == ({MISSING: log.missing} if log.missing else {})
    assert ledger.is_whole == (not log.missing)


def _numbered(*numbers: int, head: str = HEAD_V1) -> str:
    rows = (f"{n:>6}) {k}.5  Rx  0480  2  C2 08\n" for k, n in enumerate(numbers))
    return head + "".join(rows)


@pytest.mark.parametrize(
    ("text", "dropped", "unknown", "rows"),
    [
        (_numbered(1, 3, 2, 4), {}, [], 4),
        (_numbered(0, 1, 2), {}, [], 3),
        (_numbered(3, 4), {MISSING: 2}, [], 2),
        (_numbered(1, 2, 2, 3), {}, [GO_BACK], 4),
        (_numbered(1, 2, 3, 1, 2, 4), {MISSING: 1}, [GO_BACK], 6),
        (_numbered(1, 2, 5, 6, 2, 3, 4), {MISSING: 2}, [GO_BACK], 7),
        (_numbered(1, 2, 9, 4, 5), {MISFIT: 1}, [], 4),
        (_numbered(1, 2, 900_003, 4, 5), {MISFIT: 1}, [], 4),
        (_numbered(1, 2) + _numbered(1, 3), {MISSING: 1}, [], 4),
        (_numbered(1) + "gibberish\n" + _numbered(3, head=""), {NOT_UNDERSTOOD: 1}, [], 2),
        (
            _numbered(1) + "gibberish\n" + _numbered(4, head=""),
            {NOT_UNDERSTOOD: 1, MISSING: 1},
            [],
            2,
        ),
        (
            _numbered(1) + "gibberish\n" + _numbered(2, 4, head=""),
            {NOT_UNDERSTOOD: 1, MISSING: 1},
            [],
            3,
        ),
        (_numbered(1, 2) + " 5) 9.0 Warng FFFFFFFF 4 00 00 00 08 BUSHEAVY\n", {MISSING: 2}, [], 2),
        (
            _numbered(1, 2) + " 5) 9.0 Rx 0480 1 C2",
            {MISSING: 2},
            ["file may be cut after its last frame"],
            3,
        ),
    ],
)
def test_non_consecutive_message_numbers_are_reported(
    tmp_path: Path, text: str, dropped: dict[str, int], unknown: list[str], rows: int
) -> None:
    found, ledger = read_back(_log(tmp_path, text))

    assert sum(map(len, found.values())) == rows
    assert ledger.topic("").dropped == dropped
    assert ledger.topic("").dropped_unknown == unknown
