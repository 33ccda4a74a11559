"""Commands: progress, and errors in one line with the documented exit status."""

import contextlib
import io
import re
import resource
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest

from crosscue.eval import cli
from crosscue.eval import terminal as progress
from crosscue.eval.terminal import ProgressLine
from crosscue.replay.errors import CrosscueError, LogError, UsageError
from crosscue.replay.progress import Progress
from crosscue.results import Result
from support.commands import output_of
from support.refusals import refusal


@dataclass(frozen=True, slots=True, repr=False)
class Counted(Result):
    """A number that is the exit status."""

    number: int

    @property
    def exit_status(self) -> int:
        """The number."""
        return self.number


def _register_command(monkeypatch: pytest.MonkeyPatch, error: BaseException | None) -> None:
    module = ModuleType("crosscue.eval.fake")

    def fake(*, number: int = 0) -> Counted:
        """Count for the test.

        Args:
            number: The exit status.
        """
        if error is not None:
            raise error
        return Counted(number)

    fake.__module__ = module.__name__
    module.__dict__.update(fake=fake, Counted=Counted)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(cli.COMMANDS, "fake", "eval.fake:fake")
    monkeypatch.setattr(cli, "summary_of", lambda name: "count")


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (LogError("a.mcap: cut; copy it again"), 4),
        (UsageError("no such topic"), 2),
        (CrosscueError("failed"), 1),
        (KeyboardInterrupt(), 130),
        (OSError(28, "No space left on device"), 1),
        (ZeroDivisionError("a bug"), 1),
        (MemoryError(), 1),
    ],
)
def test_errors_are_one_line_with_documented_exit_status(
    monkeypatch: pytest.MonkeyPatch, error: BaseException, status: int
) -> None:
    _register_command(monkeypatch, error)

    refusal(status, "fake")


@pytest.mark.parametrize(
    "verb", ["check", "info", "score", "report", "failures", "compare", "view"]
)
def test_path_of_the_wrong_kind_is_unreadable_input(verb: str, tmp_path: Path) -> None:
    """A name that is too long, and for verbs that take runs a file."""
    more = ["again"] if verb == "compare" else []
    assert "File name too long" in refusal(4, verb, "a" * 300, *more)
    if verb not in ("check", "info"):
        file = tmp_path / "drive.mcap"
        file.write_bytes(b"")
        assert f"{file}: no manifest.json: not a run folder" in refusal(4, verb, file, *more)


def test_help_is_a_command_too() -> None:
    for given, same in (
        (["help"], ["--help"]),
        (["help", "all"], ["--help", "all"]),
        (["help", "fit"], ["fit", "--help"]),
        (["help", "fit", "signs"], ["fit", "signs", "--help"]),
    ):
        printed = output_of(*given)
        assert output_of(*same) == printed


def test_control_characters_in_an_error_are_escaped(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _register_command(monkeypatch, LogError("\x1b[31mred\x07 /t\udcff"))
    cli.run(["fake"])

    assert capsys.readouterr().err == "crosscue: \\x1b[31mred\\x07 /t\\udcff\n"


def test_help_lists_eight_commands_and_help_all_the_rest() -> None:
    short = output_of("--help")
    whole = output_of("--help", "all")

    names = re.compile(r"^  ([a-z][a-z -]*?)  +[a-z]", re.MULTILINE)
    front = {"demo", "info", "check", "replay", "score", "compare", "view", "query"}
    assert {*names.findall(short)} == front == {name for one in cli.FRONT.values() for name in one}
    assert {*names.findall(whole)} == cli.COMMANDS.keys()
    assert f"crosscue --help all lists {len(cli.COMMANDS) - 8} more" in short
    assert max(map(len, whole.splitlines())) <= 100


@pytest.mark.parametrize("group", ["fit", "landmarks", "model", "study", "train", "vehicle"])
def test_help_of_a_group_has_an_example_of_each_command(group: str) -> None:
    examples = output_of(group, "--help").partition("examples:")[2]

    for name in (name for name in cli.COMMANDS if name.startswith(f"{group} ")):
        assert re.search(rf"^  crosscue {name}\b", examples, re.MULTILINE), name
    assert "\\" not in examples


def test_help_is_coloured_on_a_terminal_only(monkeypatch: pytest.MonkeyPatch) -> None:
    def printed(is_terminal: bool) -> str:
        out = io.StringIO()
        monkeypatch.setattr(out, "isatty", lambda: is_terminal)
        with contextlib.redirect_stdout(out):
            assert cli.run(["--help"]) == 0
        return out.getvalue()

    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert "\x1b[" not in printed(False)
    assert re.sub(r"\x1b\[\d*m", "", printed(True)) == printed(False) != printed(True)
    monkeypatch.setenv("NO_COLOR", "1")
    assert "\x1b[" not in printed(True)


@pytest.mark.parametrize("argument", ["--help", "--version"])
def test_bare_help_and_version_take_under_a_fifth_of_a_cpu_second(argument: str) -> None:
    subprocess.run([sys.executable, "-m", "crosscue.eval.cli", argument], check=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, "-m", "crosscue.eval.cli", argument], check=True, stdout=subprocess.DEVNULL
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)

    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 0.2


class Terminal(io.StringIO):
    """Stream that records what is written and reports that it is a terminal."""

    def isatty(self) -> bool:
        """Return True."""
        return True


def replaced_stderr(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Replace stderr; called inside the test, because pytest replaces stderr before it."""
    made = Terminal()
    monkeypatch.setattr(sys, "stderr", made)
    monkeypatch.setattr(progress, "EVERY_S", 0.0)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("TERM", "xterm")
    return made


def shown_text(line: ProgressLine, terminal: Terminal) -> str:
    assert line._bar is not None
    terminal.truncate(0)
    line._bar.refresh()
    return terminal.getvalue()


def test_line_shows_amount_rate_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = replaced_stderr(monkeypatch)
    with ProgressLine(is_shown=True) as line:
        line.at(Progress("converting", 1500, 6000, "rows"))
        text = shown_text(line, terminal)
        line.at(Progress("converting", 3000, 6000, "rows"))

        assert "converting" in text
        assert "1,500 of 6,000 rows" in text
        assert "a second" in text
        assert "left" in text
        assert "3,000 of 6,000 rows" in shown_text(line, terminal)
