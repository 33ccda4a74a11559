"""Several open logs are all closed, even if one of them fails."""

from __future__ import annotations

from pathlib import Path

import pytest

import crosscue
from crosscue.eval.logs import log as interface
from crosscue.replay.base import Log
from crosscue.replay.errors import LogError
from crosscue.replay.limits import DEFAULT_LIMITS, Limits
from support.memory_log import MemoryLog


class RecordingOpener:
    """Open synthetic logs, except one, and record the closed ones."""

    def __init__(self) -> None:
        self.closed: list[str] = []

    def __call__(self, path: Path | str, limits: Limits = DEFAULT_LIMITS) -> Log:
        """Open a log, unless its name is ``broken``."""
        if str(path) == "broken":
            raise LogError("broken: not a log")
        closed = self.closed

        class RecordedLog(MemoryLog):
            def close(self) -> None:
                closed.append(str(self.path))

        return RecordedLog((), (), Path(path))


@pytest.fixture
def opener(monkeypatch: pytest.MonkeyPatch) -> RecordingOpener:
    recorder = RecordingOpener()
    monkeypatch.setattr(interface, "open_one", recorder)
    return recorder


def test_logs_keep_requested_order_and_are_closed_at_end(opener: RecordingOpener) -> None:
    with crosscue.open("a", "b") as drive:
        assert [str(one.path) for one in drive.logs] == ["a", "b"]
        assert opener.closed == []

    assert sorted(opener.closed) == ["a", "b"]


def test_logs_opened_before_a_failure_are_closed(opener: RecordingOpener) -> None:
    with pytest.raises(LogError, match="broken"), crosscue.open("a", "broken", "c"):
        pytest.fail("it was opened")

    assert opener.closed == ["a"]


def test_all_logs_are_closed_when_the_body_raises(opener: RecordingOpener) -> None:
    with pytest.raises(ZeroDivisionError), crosscue.open("a", "b"):
        raise ZeroDivisionError

    assert sorted(opener.closed) == ["a", "b"]
