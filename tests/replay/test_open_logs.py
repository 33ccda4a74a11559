"""Several open logs are all closed, even if one of them fails."""

from __future__ import annotations

from pathlib import Path

import pytest

import crosscue
from crosscue.eval.interface.logs import log as interface
from crosscue.replay.base import DEFAULT_LIMITS, Limits, Log, LogError
from support.memory_log import MemoryLog


class Opened:
    """Opens synthetic logs, refuses one, and records which were closed."""

    def __init__(self) -> None:
        self.closed: list[str] = []

    def __call__(self, path: Path | str, limits: Limits = DEFAULT_LIMITS) -> Log:
        """Open a log, unless its name is ``broken``."""
        if str(path) == "broken":
            raise LogError("broken: not a log")
        closed = self.closed

        class Remembered(MemoryLog):
            def close(self) -> None:
                closed.append(str(self.path))

        return Remembered((), (), Path(path))


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Opened:
    made = Opened()
    monkeypatch.setattr(interface, "open_one", made)
    return made


def test_logs_come_in_the_order_asked_for_and_are_closed_at_the_end(opened: Opened) -> None:
    with crosscue.open("a", "b") as drive:
        assert [str(one.path) for one in drive.logs] == ["a", "b"]
        assert opened.closed == []

    assert sorted(opened.closed) == ["a", "b"]


def test_when_one_cannot_be_opened_those_before_it_are_closed(opened: Opened) -> None:
    with pytest.raises(LogError, match="broken"), crosscue.open("a", "broken", "c"):
        pytest.fail("it was opened")

    assert opened.closed == ["a"]


def test_when_the_work_fails_all_are_closed(opened: Opened) -> None:
    with pytest.raises(ZeroDivisionError), crosscue.open("a", "b"):
        raise ZeroDivisionError

    assert sorted(opened.closed) == ["a", "b"]
