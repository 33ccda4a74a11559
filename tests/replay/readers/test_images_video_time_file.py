"""Time files: every notation of times is exact, and errors name the invalid line."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from crosscue.replay.errors import LogFormatError
from crosscue.replay.limits import DEFAULT_LIMITS
from crosscue.replay.readers.time_file import TimeFile, read_time_file

quick = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
moments = st.lists(st.integers(0, (1 << 62) - 1), min_size=1, max_size=20, unique=True)
S = 1_000_000_000
EUROC = [1403636579763555584, 1403636579813555456]


def read(folder: Path, text: str) -> TimeFile:
    path = folder / "timestamps.txt"
    path.write_text(text, encoding="utf-8")
    return read_time_file(path, DEFAULT_LIMITS)


@quick
@given(moments)
def test_seconds_are_parsed_to_the_nanosecond(tmp_path: Path, t_ns: list[int]) -> None:
    lines = "\n".join(f"{Decimal(t) / S:.9f}" for t in t_ns)

    assert read(tmp_path, lines).t_ns.tolist() == t_ns


@pytest.mark.parametrize(
    ("text", "t_ns", "names"),
    [
        ("0.5\n1.25\n", [S // 2, 5 * S // 4], None),
        ("1.5e-1\n2.5E1", [150_000_000, 25 * S], None),
        ("1403636579763555584\n1403636579813555456", EUROC, None),
        ("# a comment\n\n7.0\r\n8.0\r\n", [7 * S, 8 * S], None),
        ("\ufeff7.0\n8.0", [7 * S, 8 * S], None),
        ("2011-09-26 13:02:25.964389445", [1317042145964389445], None),
        ("2011-09-26T15:02:25.964389445+02:00", [1317042145964389445], None),
        ("2011-09-26 13:02:25,5", [1317042145500000000], None),
        ("a.jpg,0.5\nb.jpg,1.5", [S // 2, 3 * S // 2], ("a.jpg", "b.jpg")),
        ("0.5 rgb/a.png\n1.5 rgb/b.png", [S // 2, 3 * S // 2], ("a.png", "b.png")),
        ("a.jpg;2011-09-26 13:02:25.5", [1317042145500000000], ("a.jpg",)),
        ("2011-09-26 13:02:25.5 a.jpg", [1317042145500000000], ("a.jpg",)),
        ("name,time\na.jpg,0.5", [S // 2], ("a.jpg",)),
        ("#timestamp [ns],filename\n1403636579763555584,a.png", [1403636579763555584], ("a.png",)),
        ("frame,time_ms\n0,0\n1,40\n2,80", [0, 40_000_000, 80_000_000], None),
        ("frame,time [s],speed\n0,3,1.5\n1,4,1.6", [3 * S, 4 * S], None),
        ("timestamp_us\n1000000\n1040000", [S, 1_040_000_000], None),
        ('"name","time"\n"a b.jpg","0.5"', [S // 2], ("a b.jpg",)),
    ],
)
def test_supported_notations_are_parsed(
    tmp_path: Path, text: str, t_ns: list[int], names: tuple[str, ...] | None
) -> None:
    times = read(tmp_path, text)

    assert times.t_ns.tolist() == t_ns
    assert times.names == names


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0.1\n0.2\nlater\n", r"timestamps.txt: line 3: 'later': expected one time"),
        ("0.1\n\n# x\n0.2 0.3", "line 4: .*expected one time"),
        ("pictures of a cat", "line 1: 'pictures of a cat': expected a time"),
        ("0.1\nnan", "line 2"),
        ("-1.0", "line 1: '-1.0': expected a time from 0 on"),
        ("9999999999.5", "line 1: '9999999999.5': expected a time from 0 on and before 2116"),
        ("1e99", "line 1"),
        ("2011-02-30 13:02:25.5", "line 1: .* is not a time: day is out of range"),
        ("name,time\na.jpg", "line 2: 1 cells; expected 2"),
        ("name,time\na.jpg,soon", "line 2: 'soon' is not a time"),
        ("a.jpg,0.1\n0.2", "line 2: .*expected a file name in every line"),
        ("a.jpg,0.1\na.jpg,0.2", "'a.jpg' occurs twice"),
        ("", "no time in it"),
        ("# only words\n", "no time in it"),
        ("rate_hz: fast", "rate_hz 'fast'; expected a rate"),
        ("rate_hz: 0", "rate_hz '0'; expected a rate"),
        ("0\n1\n2\n", "integers 1 apart are read as nanoseconds"),
        ("1500000000000\n1500000000040", "integers 40 apart are read as nanoseconds"),
        ("a,b,c\n1,2,3", "line 1: 'a,b,c': expected a time"),
    ],
)
def test_invalid_line_is_refused_with_its_number(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(LogFormatError, match=message):
        read(tmp_path, text)


@quick
@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused_in_one_line(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "times.txt"
    path.write_bytes(raw)
    refusal, count = "", 1
    try:
        times = read_time_file(path, DEFAULT_LIMITS)
        count = 1 if times.period else len(times.t_ns)
    except LogFormatError as error:
        refusal = str(error)

    assert count > 0
    assert "\n" not in refusal
