"""The progress line of long commands: amount done, rate and time left."""

from __future__ import annotations

import io
import os
import pty
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from crosscue.eval.commands.shared import terminal as progress
from crosscue.eval.commands.shared.terminal import Done, DriveLine, ProgressLine
from support.gap_drive import Clock, write_drive

FRAMES: Final = 300
COMMAND: Final = (
    "import sys; from crosscue.eval.commands.shared import terminal; terminal.EVERY_S = 0.0; "
    "from crosscue.eval.cli import main; main(sys.argv[1:])"
)


class Terminal(io.StringIO):
    """Stream that records what is written, and reports to be a terminal."""

    def isatty(self) -> bool:
        """Return True."""
        return True


def stderr_of(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Replace stderr; called inside the test, because pytest replaces stderr before it."""
    made = Terminal()
    monkeypatch.setattr(sys, "stderr", made)
    monkeypatch.setattr(progress, "EVERY_S", 0.0)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("TERM", "xterm")
    return made


def shown(line: ProgressLine, terminal: Terminal) -> str:
    """Return the text that the terminal shows."""
    assert line._bar is not None
    terminal.truncate(0)
    line._bar.refresh()
    return terminal.getvalue()


def test_the_line_says_how_much_of_what_is_done_and_how_fast(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terminal = stderr_of(monkeypatch)
    with ProgressLine("converting", is_shown=True) as line:
        line.at(Done(1500, 6000, "rows"))
        text = shown(line, terminal)
        line.at(Done(3000, 6000, "rows"))

        assert "converting" in text
        assert "1,500 of 6,000 rows" in text
        assert "a second" in text
        assert "left" in text
        assert "3,000 of 6,000 rows" in shown(line, terminal)


@pytest.mark.parametrize("total", [None, 0, 5])
def test_a_total_that_is_not_known_or_too_small_is_not_shown(
    monkeypatch: pytest.MonkeyPatch, total: int | None
) -> None:
    terminal = stderr_of(monkeypatch)
    with ProgressLine("reading", is_shown=True) as line:
        line.at(Done(10, total, "rows"))
        text = shown(line, terminal)

    assert "10 rows" in text
    assert "left" not in text


def test_names_from_a_log_are_neither_markup_nor_escapes(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = stderr_of(monkeypatch)
    with ProgressLine("sealing [red]a\x1b[2Jb.bag", is_shown=True) as line:
        line.at(Done(1, 2, "MB"))
        text = shown(line, terminal)

    assert "sealing [red]a\\x1b[2Jb.bag" in text


def test_a_drive_counts_frames_then_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = stderr_of(monkeypatch)
    with DriveLine("replaying", is_shown=True) as line:
        line.at_frame(3, 10)
        assert "3 of 10 frames" in shown(line, terminal)
        line.at_time(2.0, 60.0)
        text = shown(line, terminal)

    assert "replaying" in text
    assert "2 of 60 s of log" in text
    assert "frames" not in text


def test_nothing_is_written_where_nobody_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = stderr_of(monkeypatch)
    with ProgressLine("reading", is_shown=False) as line:
        line.at(Done(1, 2, "rows"))

    assert terminal.getvalue() == ""


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("progress")
    return write_drive(folder, Clock(), seconds=FRAMES // 10)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("detect drive.mcap -o d --vehicle car.toml --detectors grey --no-cache", "of 300 frames"),
        ("replay drive.mcap -o r --vehicle car.toml", "of 30 s of log"),
        ("decode drive.mcap -o t --vehicle car.toml", "of 600 rows"),
        ("convert drive.mcap -o c.mcap", "of 600 rows"),
        ("info drive.mcap", "of 600 rows"),
    ],
    ids=lambda text: text.split()[0],
)
def test_long_commands_show_a_total_on_a_terminal(drive: Path, command: str, said: str) -> None:
    ours, theirs = pty.openpty()
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(sys.path),
        "TERM": "xterm",
        "COLUMNS": "120",
    }
    with subprocess.Popen(
        [sys.executable, "-c", COMMAND, *command.split()],
        cwd=drive.parent,
        stdout=subprocess.DEVNULL,
        stderr=theirs,
        env=environment,
    ) as process:
        os.close(theirs)
        text = _everything(ours)

    assert process.returncode == 0, text
    assert said in text


def _everything(terminal: int) -> str:
    parts = []
    with os.fdopen(terminal, "rb", buffering=0) as stream:
        while True:
            try:
                part = stream.read(65536)
            except OSError:  # Linux says so when nobody has the other end any more.
                break
            if not part:
                break
            parts.append(part)
    return b"".join(parts).decode(errors="replace")
