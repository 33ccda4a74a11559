"""The progress line of long commands: amount done, rate and time left."""

import io
import sys

import pytest

from crosscue.eval import terminal as progress
from crosscue.eval.terminal import ProgressLine
from crosscue.replay.progress import Progress


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
