"""Output of commands: results, messages, and a progress line.

The line shows the amount done, the rate and the time left. rich draws it on stderr and removes it
at the end. Without a terminal on stderr, or with ``--quiet``, rich is not imported.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, Self

from crosscue.replay.errors import one_line
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.progress import Notice, watching
from crosscue.replay.progress import Progress as Progressed
from crosscue.replay.safe_text import visible
from crosscue.results import Result

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

# Shortest time between two updates of the line.
EVERY_S: Final = 0.1


class ProgressLine:
    """Progress line of one command; a context manager, or closed by ``end``."""

    def __init__(self, *, is_shown: bool) -> None:
        """Create a line that draws nothing before the first ``at``, or unless ``is_shown``."""
        self.is_shown = is_shown
        self._began = time.monotonic()
        self._shown = -EVERY_S
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        self._unit = ""

    def at(self, event: Progressed) -> None:
        """Show the progress on stderr, which must be a terminal."""
        now = time.monotonic()
        if not self.is_shown or now - self._shown < EVERY_S:
            return
        self._shown = now
        bar, task = self._task_for(event.unit)
        total = event.total if event.total and event.total >= event.done else None
        bar.update(
            task,
            description=visible(event.doing),
            completed=event.done,
            total=total,
            amount=self._amount(event, total),
            left="left" if total else "",
        )
        # Nothing is drawn before the first progress.
        bar.start()

    def end(self) -> None:
        """Remove the line."""
        if self._bar is not None:
            self._bar.stop()
        self._bar = self._task = None
        self._began = time.monotonic()

    def _amount(self, event: Progressed, total: float | None) -> str:
        rate = event.done / max(time.monotonic() - self._began, 1e-9)
        of = "" if total is None else f" of {total:,.0f}"
        return f"{event.done:,.0f}{of} {event.unit}, {rate:,.{0 if rate >= 10 else 1}f} a second"

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


@contextmanager
def watched(args: argparse.Namespace) -> Iterator[None]:
    """Show progress on a terminal, and print parts of a result as they are finished."""
    with ProgressLine(is_shown=is_shown(args)) as line:

        def show(event: object) -> None:
            if isinstance(event, Progressed):
                line.at(event)
            else:
                line.end()
                _print_part(event, args)

        with watching(show):
            yield


def _print_part(event: object, args: argparse.Namespace) -> None:
    """Print a part of a result; one that is an error or has losses goes to stderr."""
    if isinstance(event, Exception):
        warn(one_line(event))
    elif isinstance(event, str):
        if not args.quiet:
            print(event, file=sys.stderr if args.json else sys.stdout, flush=True)
    elif isinstance(event, Notice):
        if not args.quiet:
            warn(event.text)
    elif args.json:
        pass
    elif isinstance(event, Result) and event.exit_status:
        print(event, file=sys.stderr)
    elif not args.quiet:
        print(_text(event, args) if isinstance(event, Result) else event)


def print_found(found: Any, args: argparse.Namespace) -> int:
    """Print what a verb returned, as text or as JSON; return its exit status."""
    if not isinstance(found, Result):
        if found is not None:
            print(found if isinstance(found, str) else strict_json(found))
        return 0
    shown = found.reported
    chosen = next((name for name in shown.formats if getattr(args, name)), None)
    if args.json:
        print(strict_json(shown.as_dict()))
    elif not args.quiet and not shown.is_printed_in_parts:
        text = _text(shown, args) if chosen is None else getattr(shown, chosen)()
        if text:
            print(text)
    if not args.quiet and not args.json:
        for message in shown.messages():
            print(message, file=sys.stderr)
    return shown.exit_status


def _text(result: Result, args: argparse.Namespace) -> str:
    return repr(result) if args.verbose else result.brief()


def is_shown(args: argparse.Namespace) -> bool:
    """Return True unless ``--quiet`` is set or stderr is not a terminal."""
    return not args.quiet and sys.stderr.isatty()


def warn(sentence: str) -> None:
    """Print one line on stderr, with control characters escaped."""
    print(f"crosscue: {visible(sentence)}", file=sys.stderr)


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
        # Results are printed on stdout during the work; rich would redirect them to stderr.
        redirect_stdout=False,
        redirect_stderr=False,
    )
