"""candump and BUSMASTER logs: every line is used, skipped or dropped."""

from __future__ import annotations

from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.base import Selection
from crosscue.replay.columns import DATA, ERROR, REMOTE
from crosscue.replay.errors import LogFormatError
from crosscue.replay.logs.opening import open_log
from crosscue.replay.readers.can_text import dialect as can_text
from crosscue.replay.readers.can_text import digits
from crosscue.replay.readers.can_text.lines import Lines, Overlong, Tail, read_lines
from support.can_files import (
    Sent,
    assert_equal_to_python_can,
    by_bus,
    candump,
    random_frames,
    read_back,
)
from support.data import shared

VALID_LINE = "(1.000000) can0 123#DEADBEEF\n"


def _log(folder: Path, text: str | bytes, name: str = "x.log") -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


@given(st.integers(0, 2**31), st.booleans())
@settings(max_examples=15, deadline=None)
def test_frames_survive_write_and_read(
    tmp_path_factory: pytest.TempPathFactory, seed: int, fd: bool
) -> None:
    frames = random_frames(300, seed, fd=fd)
    path = _log(tmp_path_factory.mktemp("log"), candump(frames))

    found, ledger = read_back(path)

    assert found == by_bus(frames, "can{}")
    assert ledger.is_whole


def test_chunk_boundaries_do_not_change_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = random_frames(400)
    path = _log(tmp_path, candump(frames))
    monkeypatch.setattr(can_text, "read_lines", lambda p, _=0: read_lines(p, 400))

    found, ledger = read_back(path)

    assert found == by_bus(frames, "can{}")
    assert ledger.is_whole


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


def test_line_broken_in_two_is_not_read_as_shorter_frame(tmp_path: Path) -> None:
    found, ledger = read_back(
        _log(tmp_path, VALID_LINE + "(2.0) can0 123#DE\nADBEEF\n" + VALID_LINE)
    )

    assert [f.payload for f in found["can0"]] == [b"\xde\xad\xbe\xef"] * 2
    assert ledger.topic("can0").dropped.total() == 1
    assert ledger.topic("").dropped.total() == 1


def test_last_line_without_line_end_is_dropped(tmp_path: Path) -> None:
    found, ledger = read_back(_log(tmp_path, VALID_LINE + VALID_LINE[:-3]))

    assert len(found["can0"]) == 1
    assert ledger.topic("").dropped == {"last line has no line end, may be cut": 1}


@pytest.mark.slow
def test_truncation_is_reported_and_adds_no_frames(tmp_path: Path) -> None:
    frames = random_frames(14)
    text = candump(frames)
    ends = {0, *(k + 1 for k, c in enumerate(text) if c == 10)}
    for at in range(1, len(text), 3):
        whole = text[:at].count(b"\n")
        path = _log(tmp_path, text[:at])
        if not whole:
            with pytest.raises(LogFormatError, match="candump"):
                open_log(path)
            continue

        found, ledger = read_back(path)

        assert found == by_bus(frames[:whole], "can{}")
        assert ledger.is_whole == (at in ends)


def test_unselected_frames_are_counted_but_not_read(tmp_path: Path) -> None:
    frames = random_frames(500)
    path = _log(tmp_path, candump(frames))
    lo, hi = frames[100].t_ns, frames[300].t_ns

    found, ledger = read_back(path, Selection(frozenset({"can1"}), lo, hi))

    expected = [f for f in by_bus(frames, "can{}")["can1"] if lo <= f.t_ns < hi]
    assert found == {"can1": expected}
    for name in ("can1", "can2"):
        assert ledger.topic(name).found == len(by_bus(frames, "can{}")[name])
    assert ledger.topic("can2").used == 0


def test_bus_first_seen_late_becomes_topic(tmp_path: Path) -> None:
    text = VALID_LINE * 5000 + VALID_LINE.replace("can0", "can7")
    with open_log(_log(tmp_path, text)) as log:
        assert [t.name for t in log.topics] == ["can0"]
    found, _ = read_back(_log(tmp_path, text))
    assert len(found["can7"]) == 1


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


def test_line_longer_than_chunk_is_reported_and_next_lines_are_read(tmp_path: Path) -> None:
    path = _log(tmp_path, b"a\n" + b"x" * 1000 + b"\nb\nc\n")
    overlong: list[int] = []
    read: list[bytes] = []

    # Each piece is valid only until the next one, because they share a buffer.
    for piece in read_lines(path, 64):
        if isinstance(piece, Lines):
            read += [piece.text(i) for i in range(piece.done)]
        else:
            assert isinstance(piece, Overlong)
            overlong.append(piece.number)

    assert overlong == [2]
    assert read == [b"a", b"b", b"c"]


@pytest.mark.parametrize("byte", range(256))
def test_digit_parsers_accept_only_digits(byte: int) -> None:
    buffer = np.full(digits.FRONT + digits.BACK, ord("1"), np.uint8)
    buffer[digits.FRONT + 1] = byte
    stop, count = np.array([digits.FRONT + 3]), np.array([3])
    for read, base, alphabet in (
        (digits.decimal, 10, b"0123456789"),
        (digits.hexadecimal, 16, b"0123456789abcdefABCDEF"),
    ):
        value, ok = read(digits.byte_words(buffer), stop, count)
        assert bool(ok[0]) == (byte in alphabet)
        if ok[0]:
            assert value[0] == int(f"1{chr(byte)}1", base)


def test_ford_log_matches_python_can() -> None:
    path = shared(
        "can", "ford_fusion_2017", "acc_on_speed_changing_from_30km_to_80km_per_hour.candump"
    )
    assert_equal_to_python_can(path, can.CanutilsLogReader(path))


def test_savvycan_log_matches_python_can() -> None:
    path = shared("can", "savvycan", "candump.log")
    assert_equal_to_python_can(path, can.CanutilsLogReader(path))


@pytest.mark.slow
def test_busmaster_log_has_same_frames_as_candump_log() -> None:
    busmaster, ledger = read_back(shared("can", "savvycan", "BusMasterLog.log"))
    candump_, _ = read_back(shared("can", "savvycan", "candump.log"))

    assert ledger.is_whole
    assert [(f.arbitration_id, f.payload) for f in busmaster["can/0"]] == [
        (f.arbitration_id, f.payload) for f in candump_["vcan0"]
    ]
