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

from crosscue.eval import terminal as progress
from crosscue.eval.terminal import Done, ProgressLine
from support.gap_drive import Clock, write_drive

FRAMES: Final = 300
COMMAND: Final = (
    "import sys; from crosscue.eval import terminal; terminal.EVERY_S = 0.0; "
    "from crosscue.eval.cli import main; main(sys.argv[1:])"
)


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
    """Return the text that the terminal shows."""
    assert line._bar is not None
    terminal.truncate(0)
    line._bar.refresh()
    return terminal.getvalue()


def test_line_shows_amount_rate_and_time_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terminal = replaced_stderr(monkeypatch)
    with ProgressLine("converting", is_shown=True) as line:
        line.at(Done(1500, 6000, "rows"))
        text = shown_text(line, terminal)
        line.at(Done(3000, 6000, "rows"))

        assert "converting" in text
        assert "1,500 of 6,000 rows" in text
        assert "a second" in text
        assert "left" in text
        assert "3,000 of 6,000 rows" in shown_text(line, terminal)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("progress")
    return write_drive(folder, Clock(), seconds=FRAMES // 10)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "total"),
    [
        ("detect drive.mcap -o d --vehicle car.toml --detectors grey --no-cache", "of 300 frames"),
        ("replay drive.mcap -o r --vehicle car.toml", "of 30 s of log"),
        ("decode drive.mcap -o t --vehicle car.toml", "of 600 rows"),
        ("convert drive.mcap -o c.mcap", "of 600 rows"),
        ("info drive.mcap", "of 600 rows"),
    ],
    ids=lambda text: text.split()[0],
)
def test_long_commands_show_a_total_on_a_terminal(drive: Path, command: str, total: str) -> None:
    reading_end, writing_end = pty.openpty()
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
        stderr=writing_end,
        env=environment,
    ) as process:
        os.close(writing_end)
        text = _read_to_end(reading_end)

    assert process.returncode == 0, text
    assert total in text


def _read_to_end(terminal: int) -> str:
    parts = []
    with os.fdopen(terminal, "rb", buffering=0) as stream:
        while True:
            try:
                part = stream.read(65536)
            except OSError:  # Linux raises this once the other end is closed.
                break
            if not part:
                break
            parts.append(part)
    return b"".join(parts).decode(errors="replace")
