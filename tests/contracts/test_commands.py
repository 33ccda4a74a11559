"""Behaviour common to all commands: help, wrong usage, missing input, pipes and JSON."""

import argparse
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from crosscue.eval import cli
from crosscue.replay.errors import one_line
from support.commands import output_of
from support.refusals import refusal

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


def actions(name: str) -> list[argparse.Action]:
    """Arguments and options of one command, without ``--help``."""
    _, parser = cli.parser_of(name)
    return [one for one in parser._actions if "--help" not in one.option_strings]


OPTIONS: Final = sorted(
    (name, option)
    for name in cli.COMMANDS
    for action in actions(name)
    for option in action.option_strings
    if option.startswith("--")
)


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_help_has_exit_status_and_examples_that_can_be_parsed(name: str) -> None:
    text = output_of(*name.split(), "--help")
    assert "exit status" in text
    examples = text.replace("\\\n", " ").partition("example")[2]
    assert examples
    for line in re.findall(r"^  crosscue (.+?)(?: >.*|  +[a-z].*| \|.*)?$", examples, re.MULTILINE):
        words = shlex.split(line)
        command = max(
            (one for one in cli.COMMANDS if words[: len(one.split())] == one.split()), key=len
        )
        _, parser = cli.parser_of(command)
        parser.parse_args(words[len(command.split()) :])


@pytest.mark.parametrize("streams", STREAMS)
@pytest.mark.parametrize(
    ("command", "status"), [("--help", 0), ("info gone.mcap", 4), ("truth schema", 0)]
)
def test_closed_or_full_stream_causes_no_traceback(
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
    # A failed write is status 1, unless the command ends before the reader does.
    failed = "1" if streams in ("reader gone", "reader stops", "stdout full") else str(status)
    assert found in {failed, str(status)}
    if streams == "stdout full" and status == 0:
        assert found == "1"


@pytest.mark.parametrize(("name", "option"), OPTIONS)
def test_misspelt_option_is_refused_with_suggestion(name: str, option: str) -> None:
    # Required arguments are missing, too: the misspelt option is reported first.
    message = _refused(*name.split(), option + "x")
    assert f"no option {option}x; did you mean {option}?" in message


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_misspelt_command_is_refused_with_suggestion(name: str) -> None:
    first, _, second = name.partition(" ")
    misspelt = [first[:-2] + first[-1] + first[-2], *second.split()]

    assert f"did you mean {name!r}?" in _refused(*misspelt)


def test_command_group_alone_lists_its_commands() -> None:
    assert "fit: needs one of: fit compass, fit odometry" in _refused("fit")
    assert output_of("fit", "--help").startswith("  fit compass ")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts_are_printed(shell: str) -> None:
    assert "crosscue" in output_of("completion", shell)


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("crosscue re", {"replay", "report"}),
        ("crosscue ", {name.split()[0] for name in cli.COMMANDS}),
        ("crosscue fit ", {n.partition(" ")[2] for n in cli.COMMANDS if n.startswith("fit ")}),
        ("crosscue truth i", {"import"}),
        ("crosscue check t.json --pic", {"--picture"}),
        ("crosscue replay drive.mcap --wor", {"--workers"}),
        ("crosscue simulate A --traffic ", {"left", "right"}),
        ("crosscue completion z", {"zsh"}),
        ("crosscue info dri", {"drive.mcap"}),
        ("crosscue truth dri", {"drive.mcap"}),
        ("crosscue info 'dri", {"drive.mcap"}),
    ],
)
def test_shell_completion_offers_valid_continuations(
    line: str, offered: set[str], tmp_path: Path
) -> None:
    (tmp_path / "drive.mcap").touch()
    out = tmp_path / "offered"
    environment = {
        **os.environ,
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(out),
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
    }
    subprocess.run(
        [sys.executable, "-m", "crosscue.eval.cli"],
        cwd=tmp_path,
        env=environment,
        check=True,
        timeout=60,
    )

    found = {word.strip() for word in out.read_text().split("\013")}
    assert found - {"--help", "--version", "offered"} == offered


def _refused(*words: str) -> str:
    message = refusal(2, *words)
    assert message == one_line(ValueError(message)) + "\n"
    assert "Traceback" not in message
    assert "bug" not in message
    return message
