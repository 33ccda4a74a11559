"""Errors of commands: one line, the documented exit status, no traceback without -v."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from types import ModuleType

import pytest

from crosscue.eval import cli
from crosscue.replay.errors import CrosscueError, LogError, UsageError
from crosscue.results import Result


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
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: BaseException,
    status: int,
) -> None:
    _register_command(monkeypatch, error)

    assert cli.run(["fake"]) == status
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("crosscue: ")
    assert captured.err.count("\n") == 1


def test_control_characters_in_an_error_are_escaped(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _register_command(monkeypatch, LogError("\x1b[31mred\x07 /t\udcff"))
    cli.run(["fake"])

    assert capsys.readouterr().err == "crosscue: \\x1b[31mred\\x07 /t\\udcff\n"


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_help_of_each_command_has_example_and_exit_status(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run([*name.split(), "--help"]) == 0
    help_text = capsys.readouterr().out
    assert "example" in help_text
    assert "exit status" in help_text


def test_help_imports_no_heavy_packages() -> None:
    code = (
        "import sys; from crosscue.eval import cli; cli.run(['--help']);"
        "heavy = {'numpy', 'torch', 'rerun', 'pyarrow', 'pydantic'} & set(sys.modules);"
        "sys.exit(f'imported: {heavy}' if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
