"""Times beyond what can be stored, and times that run backward, are reported for what they are."""

from pathlib import Path

import pytest

from crosscue.eval import cli
from support.commands import output_of
from support.mcap_files import ChunkOf, McapFile, channel, message, schema
from support.refusals import refusal

AFTER_2262_NS = (1 << 63) + 10**9
CANDUMP = "".join(f"({9_300_000_000 + k}.000000) can0 064#0011\n" for k in range(30))
ASC = (
    "date Thu Jan 1 00:00:00.000 am 2290\nbase hex  timestamps absolute\n"
    "no internal events logged\n" + "   0.100000 1  64             Rx   d 2 00 11\n" * 3
)


def _mcap(path: Path, start_ns: int, step_ns: int) -> Path:
    rows = [message(1, start_ns + k * step_ns, b'{"speed_mps": 1}') for k in range(30)]
    named = [schema(1, "a", "jsonschema", b"{}"), channel(1, 1, "/a", "json")]
    path.write_bytes(McapFile([ChunkOf([*named, *rows])]).coded())
    return path


@pytest.mark.parametrize("command", ["decode", "replay"])
def test_log_after_2262_names_its_times_as_reason(command: str, tmp_path: Path) -> None:
    log = _mcap(tmp_path / "late.mcap", AFTER_2262_NS, 10**8)

    error = refusal(1, command, log, "-o", tmp_path / "out")
    assert "holds 30 rows, none usable (30 of them: log time after the year 2262" in error


def test_text_log_after_2115_names_its_times_as_reason(tmp_path: Path) -> None:
    (tmp_path / "can.log").write_text(CANDUMP)
    (tmp_path / "can.asc").write_text(ASC)

    error = refusal(4, "info", tmp_path / "can.log")
    assert "time of the year 2116 or later, which is out of range" in error
    assert "no readable start date before 2116" in output_of("info", tmp_path / "can.asc")


def test_rows_after_2115_are_not_called_missing(tmp_path: Path) -> None:
    log = _mcap(tmp_path / "late.mcap", AFTER_2262_NS - 10 * 10**9, 10**8)

    assert "time       no rows with a time from 1970 to 2115" in output_of("info", log)


@pytest.mark.parametrize("step_ns", [-(10**7), -(10**9)])
@pytest.mark.parametrize("command", ["info", "decode"])
def test_log_with_all_times_reversed_has_a_notice(
    command: str, step_ns: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = _mcap(tmp_path / "back.mcap", 1_700_000_000 * 10**9, step_ns)
    options = [] if command == "info" else ["-o", str(tmp_path / "out")]

    assert cli.run([command, str(log), *options]) in (0, 3)

    printed = " ".join(capsys.readouterr().out.split())
    assert "/a: every one of its 30 rows is earlier in log time than the row before" in printed
