"""What holds for every command of the table: help, wrong usage, missing input, pipes, JSON."""

import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from crosscue.eval import cli
from crosscue.replay.errors import one_line

RECORDING: Final = 4
"""A recording, database or picture that cannot be read; docs/exit_status.md."""
RUN: Final = 1
"""A run folder or annotations."""
SETTINGS: Final = 2
"""A file of settings."""

MISSING: Final[dict[str, tuple[str, int]]] = {
    "info": ("gone.mcap", RECORDING),
    "convert": ("gone.mcap -o out.mcap", RECORDING),
    "vehicle init": ("gone.mcap", RECORDING),
    "decode": ("gone.mcap -o out", RECORDING),
    "detect": ("gone.mcap -o out --detectors signs", RECORDING),
    "estimate": ("gone", RUN),
    "replay": ("gone.mcap -o out", RECORDING),
    "score": ("gone", RUN),
    "compare": ("gone gone2", RUN),
    "merge": ("gone -o out", RUN),
    "view": ("gone --save x.rrd", RUN),
    "fit compass": ("gone.mcap --vehicle gone.toml", SETTINGS),
    "fit signs": ("gone.json --label a", SETTINGS),
    "fit ranges": ("--cue stop_sign --truth gone.json", RUN),
    "fit messages": ("gone --truth gone.json", RUN),
    "fit landmarks": ("--pairs gone.csv", RUN),
    "landmarks add": ("gone.db --images gone --coordinates gone.csv", RUN),
    "landmarks list": ("gone.db", RECORDING),
    "landmarks match": ("gone.db gone.png", RECORDING),
    "truth": ("gone -o out", RECORDING),
    "truth import": ("gone.json --log gone.mcap -o t.json", RUN),
    "truth check": ("gone.json --log gone.mcap", RUN),
    "train road": ("--data gone -o x.safetensors", SETTINGS),
    "train mask-rcnn": ("--data gone.json --images gone -o x.safetensors", RUN),
    "seal": ("gone.mcap", RECORDING),
    "study intersections": ("-o out --vehicle gone.toml", SETTINGS),
    "study range": ("-o out --settings gone.toml", SETTINGS),
    "study landmarks": ("-o out --settings gone.toml", SETTINGS),
    "study field": ("-o out --settings gone.toml", SETTINGS),
}
READS_NOTHING: Final = {
    "truth schema",
    "simulate",
    "train frames",
    "study drive",
    "demo",
    "plugins",
}
ALWAYS_JSON: Final = {"truth schema"}
PRINTS_NO_RESULT: Final = {"view"}

STREAMS: Final = {
    "reader gone": "| true",
    "reader stops": "| head -c 1 > /dev/null",
    "stdout closed": ">&-",
    "stderr closed": "2>&-",
    "both closed": ">&- 2>&-",
    "all closed": "<&- >&- 2>&-",
    "messages unread": "2>&1 > /dev/null | true",
    "stdout full": "> /dev/full",
    "stderr full": "2> /dev/full",
}


def test_the_table_of_this_test_is_whole() -> None:
    assert MISSING.keys() | READS_NOTHING == cli.COMMANDS.keys()


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_help_has_an_example_of_the_command_itself(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run([*name.split(), "--help"]) == 0
    said = capsys.readouterr().out
    assert f"\n  crosscue {name}" in said.partition("example")[2]


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_an_unknown_option_is_wrong_usage_in_one_line(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run([*name.split(), "--surely-unknown"]) == 2
    _is_one_line(capsys.readouterr().err)


@pytest.mark.parametrize("name", sorted(MISSING))
def test_missing_input_is_one_line_and_leaves_nothing(
    name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text, status = MISSING[name]

    assert cli.run([*name.split(), *text.split()]) == status
    captured = capsys.readouterr()
    assert captured.out == ""
    _is_one_line(captured.err)
    assert "gone" in captured.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", sorted(cli.COMMANDS.keys() - ALWAYS_JSON - PRINTS_NO_RESULT))
def test_results_can_be_had_as_json(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    cli.run([*name.split(), "--help"])
    assert "--json" in capsys.readouterr().out


@pytest.mark.parametrize("streams", STREAMS)
@pytest.mark.parametrize(
    ("command", "status"),
    [("--help", 0), ("info gone.mcap", 4), ("truth schema", 0), ("nosuch", 2)],
)
def test_no_stream_that_is_gone_or_full_brings_a_traceback(
    command: str, status: int, streams: str, tmp_path: Path
) -> None:
    line = (
        f"{sys.executable} -m crosscue.eval.cli {command} {STREAMS[streams]}\n"
        'echo "status ${PIPESTATUS[0]}" >&9'
    )
    done = subprocess.run(
        ["bash", "-c", f"exec 9>{tmp_path / 'status'}\n{line}"],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )

    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert done.stderr.count("\n") <= 1
    found = (tmp_path / "status").read_text().split()[1]
    # What could not be written is a failure; the same command may have been quicker than that.
    failed = "1" if streams in ("reader gone", "reader stops", "stdout full") else str(status)
    assert found in {failed, str(status)}
    if streams == "stdout full" and status == 0:
        assert found == "1"


def test_an_option_with_a_slip_gets_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["info", "x.mcap", "--jsno"]) == 2
    assert "did you mean --json?" in capsys.readouterr().err


def _is_one_line(text: str) -> None:
    assert text.startswith("crosscue: ")
    assert text == one_line(ValueError(text)) + "\n"
    assert "Traceback" not in text
    assert "bug" not in text
