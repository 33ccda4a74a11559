"""candump and BUSMASTER logs: every line is used, skipped or dropped."""

from __future__ import annotations

from pathlib import Path

import pytest

from crosscue.replay.columns import DATA, ERROR, REMOTE
from crosscue.replay.errors import LogFormatError
from crosscue.replay.logs.opening import open_log
from crosscue.replay.readers.can_text.lines import Lines, Tail, read_lines
from support.can_files import (
    Sent,
    read_back,
)
from support.data import shared

VALID_LINE = "(1.000000) can0 123#DEADBEEF\n"


def _log(folder: Path, text: str | bytes, name: str = "x.log") -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


@pytest.mark.parametrize(
    ("line", "frame"),
    [
        ("(1.5) can0 123#", Sent(1_500_000_000, "can0", 0x123, b"")),
        ("(1.000000001) can0 123#AA", Sent(1_000_000_001, "can0", 0x123, b"\xaa")),
        ("(0001.5) a 7FF#aa R", Sent(1_500_000_000, "a", 0x7FF, b"\xaa")),
        ("(1.5) can0 00000123#AA T", Sent(1_500_000_000, "can0", 0x123, b"\xaa", True)),
        ("(1.5) can0 123#R", Sent(1_500_000_000, "can0", 0x123, b"", False, REMOTE)),
        ("(1.5) can0 123#R8 R", Sent(1_500_000_000, "can0", 0x123, b"", False, REMOTE)),
        ("(1.5) can0 20000088#0001", Sent(1_500_000_000, "can0", 0x88, b"\0\1", False, ERROR)),
        ("(1.5) can0 123##3", Sent(1_500_000_000, "can0", 0x123, b"", False, DATA, True)),
        (
            "(1.5) can0 123#1122334455667788_E",
            Sent(1_500_000_000, "can0", 0x123, b'\x11"3DUfw\x88'),
        ),
        (" (1.5)  can0  123   [2]  0A 0B", Sent(1_500_000_000, "can0", 0x123, b"\n\x0b")),
        (
            " (1.5)  can0  123   [0]  remote request",
            Sent(1_500_000_000, "can0", 0x123, b"", False, REMOTE),
        ),
        ("(1.5) 0 123#AA\r", Sent(1_500_000_000, "can/0", 0x123, b"\xaa")),
    ],
)
def test_valid_line_is_read_as_expected_frame(tmp_path: Path, line: str, frame: Sent) -> None:
    found, ledger = read_back(_log(tmp_path, line + "\n"))

    assert found == {frame.bus: [frame]}
    assert ledger.is_whole


@pytest.mark.parametrize(
    "line",
    [
        "(nan) can0 123#AA",
        "(inf) can0 123#AA",
        "(-1.0) can0 123#AA",
        "(99999999999.0) can0 123#AA",
        "(9223372036.9) can0 123#AA",
        "(1.0) can0 123#AAB",
        "(1.0) can0 123#AG",
        "(1.0) can0 FFF#AA",
        "(1.0) can0 40000000#AA",
        "(1.0) can0 1234#AA",
        "(1.0) can0 123#112233445566778899",
        "(1.0) can0 123##1112233445566778899",
        "(1.0) can0 123##G11",
        "(1.0) can0 123 AA",
        "(1.0) c\x01n0 123#AA",
        "(1.0)  123#AA",
        "(1.0) can0 123#AA X",
        "(1.0 can0 123#AA",
        " (1.5)  can0  123   [3]  0A 0B",
        "(1.0) can0 123#" + "A" * 20_000,
    ],
)
def test_invalid_line_is_dropped_and_reported(tmp_path: Path, line: str) -> None:
    found, ledger = read_back(_log(tmp_path, VALID_LINE + line + "\n" + VALID_LINE))

    assert len(found["can0"]) == 2
    assert ledger.topic("").dropped.total() == 1
    assert "line 2" in next(ledger.drops()).detail


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "empty"),
        (b"\x1f\x8b\x08abc", "gzip"),
        ("(1.0) can0 1#\n".encode("utf-16"), "UTF-16"),
        (b"  can0  123   [8]  00 11 22 33 44 55 66 77\n", "without times"),
        (b" (2015-07-10 06:17:32.249713)  can0  123   [1]  DE\n", "time zone"),
        (b"hello\nworld\n", "no frame of a candump log"),
        (bytes(200_000), "without a line end"),
    ],
)
def test_unsupported_file_is_refused_in_one_line(
    tmp_path: Path, content: bytes, match: str
) -> None:
    with pytest.raises(LogFormatError, match=match) as refused:
        open_log(_log(tmp_path, content))
    assert "\n" not in str(refused.value)


def test_zeroed_span_drops_only_affected_lines(tmp_path: Path) -> None:
    text = VALID_LINE * 10 + "\0" * 3_000_000 + "\n" + VALID_LINE * 10

    found, ledger = read_back(_log(tmp_path, text))

    assert len(found["can0"]) == 20
    assert not ledger.is_whole


def test_frames_beyond_bus_limit_are_dropped(tmp_path: Path) -> None:
    text = "".join(f"(1.0) can{k} 123#AA\n" for k in range(1000))

    found, ledger = read_back(_log(tmp_path, text))

    assert len(found) == 256
    assert ledger.topic("").dropped == {"more buses than a log can have": 744}


@pytest.mark.parametrize("size", [64, 100, 1000])
def test_lines_are_complete_for_any_chunk_size(tmp_path: Path, size: int) -> None:
    lines = [b"x" * (k % 29) for k in range(300)]
    path = _log(tmp_path, b"\n".join(lines) + b"\r\nlast")
    got: list[bytes] = []
    for piece in read_lines(path, size):
        if isinstance(piece, Lines):
            assert piece.first_number == len(got) + 1
            got += [piece.text(i) for i in range(piece.done)]
        else:
            assert isinstance(piece, Tail)
            got.append(piece.text)
    assert got == [*lines, b"last"]


@pytest.mark.slow
def test_busmaster_log_has_same_frames_as_candump_log() -> None:
    busmaster, ledger = read_back(shared("can", "savvycan", "BusMasterLog.log"))
    candump_, _ = read_back(shared("can", "savvycan", "candump.log"))

    assert ledger.is_whole
    assert [(f.arbitration_id, f.payload) for f in busmaster["can/0"]] == [
        (f.arbitration_id, f.payload) for f in candump_["vcan0"]
    ]
