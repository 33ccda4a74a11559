"""One line on a terminal while a long command works: how much is done, how fast, how long still.

rich draws it, on stderr, and takes it away at the end; where stderr is no terminal, or with
``--quiet``, nothing is written and rich is not imported.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Final, NamedTuple, Self, TypeVar

from crosscue.replay.base import visible

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from crosscue.eval.batch.jobs import Progress as Progressed

T = TypeVar("T")

EVERY_S: Final = 0.1
"""The line is brought up to date no more often."""


class Done(NamedTuple):
    """How far the work is.

    Attributes:
        amount: What is done.
        total: What there is to do; None or 0 where that is not known.
        unit: What is counted, as a plural.
    """

    amount: float
    total: float | None
    unit: str


class ProgressLine:
    """The line of one command; a context manager, or ended by ``end``."""

    def __init__(self, what: str, *, is_shown: bool) -> None:
        """Write nothing unless ``is_shown``, and nothing before the first ``at``.

        Args:
            what: The word before the bar.
            is_shown: Is this wanted, and stderr a terminal?
        """
        self.is_shown = is_shown
        self._what = what
        self._began = time.monotonic()
        self._shown = -EVERY_S
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        self._unit = ""

    def at(self, done: Done, what: str = "") -> None:
        """So far the work has come; ``what`` is another word, for another stage of it."""
        now = time.monotonic()
        if not self.is_shown or now - self._shown < EVERY_S:
            return
        self._shown = now
        bar, task = self._task_for(done.unit)
        total = done.total if done.total and done.total >= done.amount else None
        bar.update(
            task,
            description=visible(what or self._what),
            completed=done.amount,
            total=total,
            amount=self._amount(done._replace(total=total)),
            left="left" if total else "",
        )
        # Only now is there something to show.
        bar.start()

    def counting(self, unit: str, per: float = 1.0) -> Callable[[float, float | None], None]:
        """A function to be called with what is done and the total, of which ``per`` are a unit."""

        def count(done: float, of: float | None) -> None:
            self.at(Done(done / per, None if of is None else of / per, unit))

        return count

    def end(self) -> None:
        """Take the line away."""
        if self._bar is not None:
            self._bar.stop()
        self._bar = self._task = None
        self._began = time.monotonic()

    def _amount(self, done: Done) -> str:
        rate = done.amount / max(time.monotonic() - self._began, 1e-9)
        of = "" if done.total is None else f" of {done.total:,.0f}"
        return f"{done.amount:,.0f}{of} {done.unit}, {rate:,.{0 if rate >= 10 else 1}f} a second"

    def _task_for(self, unit: str) -> tuple[Progress, TaskID]:
        if self._bar is None:
            self._bar = _new_bar()
        if self._task is None or unit != self._unit:
            if self._task is not None:
                self._bar.remove_task(self._task)
                self._began = time.monotonic()
            self._unit = unit
            self._task = self._bar.add_task("", total=None, amount="", left="")
        return self._bar, self._task

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failure: object) -> None:
        self.end()


class DriveLine(ProgressLine):
    """Of one drive: frames while detectors look at them, then seconds of the log."""

    def at_frame(self, done: int, of: int | None) -> None:
        """So many frames are done."""
        self.at(Done(done, of, "frames"), "detecting")

    def at_time(self, done_s: float, of_s: float) -> None:
        """So many seconds are done."""
        self.at(Done(done_s, of_s, "s of log"))


class DrivesLine(ProgressLine):
    """Of many drives."""

    def __call__(self, at: Progressed) -> None:
        """So many drives are done."""
        failed = f", {at.failed} failed" if at.failed else ""
        self.at(Done(at.done, at.total - at.earlier, "drives"), f"{self._what}{failed}")


def is_shown(args: argparse.Namespace) -> bool:
    """Is a line wanted, and is there a terminal for it?"""
    return not args.quiet and sys.stderr.isatty()


def progress_line(args: argparse.Namespace, what: str) -> ProgressLine:
    """The line of a command with these arguments."""
    return ProgressLine(what, is_shown=is_shown(args))


def with_progress(
    items: Iterable[T], done: Callable[[], Done], args: argparse.Namespace, what: str
) -> Iterator[T]:
    """Yield ``items``; on a terminal, keep one line with what is done, rate and time left.

    Args:
        items: What is worked through.
        done: Asked after each item.
        args: With ``quiet``.
        what: The word before the bar.
    """
    with progress_line(args, what) as line:
        for item in items:
            yield item
            if line.is_shown:
                line.at(done())


def _new_bar() -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),
        TextColumn("{task.fields[amount]}", markup=False),
        TimeRemainingColumn(compact=True),
        TextColumn("{task.fields[left]}"),
        console=Console(stderr=True),
        transient=True,
        # Results are printed on stdout as they come; rich would print them on stderr.
        redirect_stdout=False,
        redirect_stderr=False,
    )
