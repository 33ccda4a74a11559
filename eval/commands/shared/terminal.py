"""Shared options of commands, functions that print results, and a progress line.

The line shows the amount done, the rate and the time left. rich draws it on stderr and removes it
at the end. Without a terminal on stderr, or with ``--quiet``, rich is not imported.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol, Self, TypeVar

import crosscue
from crosscue.replay.base import (
    DEFAULT_LIMITS,
    Limits,
    OutputError,
    strict_json,
    visible,
    write_text,
)

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from crosscue.eval.batch.jobs import Progress as Progressed

T = TypeVar("T")


def add_log_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``LOG...``, ``--from``, ``--to`` and ``--topics``."""
    parser.add_argument(
        "logs", nargs="+", metavar="LOG", help="recordings of one drive; paths or URLs"
    )
    add_part_arguments(parser)


def add_part_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--from``, ``--to`` and ``--topics``."""
    parser.add_argument(
        "--from",
        dest="start",
        metavar="T",
        help="start time: seconds from the first message (12.5), or absolute nanoseconds (17...ns)",
    )
    parser.add_argument(
        "--to", dest="end", metavar="T", help="end time, exclusive, in the same form"
    )
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="read only these topics")
    add_limit_arguments(parser)


def add_first_pose_arguments(parser: argparse.ArgumentParser, default: str) -> None:
    """Add ``--gnss`` and ``--start``."""
    parser.add_argument(
        "--gnss",
        choices=("start", "truth", "fuse", "off"),
        help="use of GNSS: for the first pose and heading, only as truth, for the first pose and "
        f"every later position, or not at all (default: {default})",
    )
    parser.add_argument(
        "--start",
        dest="first_pose",
        metavar="POSE",
        help="first pose: X,Y,HEADING in metres and degrees counter-clockwise from east, or a "
        "truth file with a track",
    )


def add_annotated_runs(parser: argparse.ArgumentParser) -> None:
    """Add ``RUN...`` and ``--truth``, which names one truth file per run."""
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run folders")
    parser.add_argument(
        "--truth",
        nargs="+",
        required=True,
        type=Path,
        metavar="T.json",
        help="truth of each run, in the same order",
    )


def add_truth_of_runs(parser: argparse.ArgumentParser) -> None:
    """Add ``--truth`` and ``--any-log``, for commands whose runs each have a truth file."""
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="T.json",
        help="truth of all runs (default: truth.json next to each run's log)",
    )
    parser.add_argument(
        "--any-log",
        action="store_true",
        help="accept truth made for another file of the same drive, such as a converted log",
    )


def add_choice_of_failures(parser: argparse.ArgumentParser) -> None:
    """Add ``--top`` and ``--threshold``."""
    parser.add_argument(
        "--top",
        type=int,
        metavar="N",
        help="only N failures, from as many causes and runs as possible (default: all)",
    )
    parser.add_argument(
        "--threshold",
        type=float,
        default=0.9,
        metavar="P",
        help="probability above which a feature counts as believed (default: 0.9)",
    )


def add_file_output(parser: argparse.ArgumentParser, metavar: str, what: str) -> None:
    """Add ``-o``, ``--overwrite`` and ``--json``, for commands that write one file."""
    parser.add_argument("-o", "--output", type=Path, metavar=metavar, help=what)
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def add_limit_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--max-chunk``."""
    parser.add_argument(
        "--max-chunk",
        type=_mebibytes,
        default=DEFAULT_LIMITS.chunk_bytes,
        metavar="MIB",
        help="largest chunk, container or page to decompress, in MiB "
        f"(default: {DEFAULT_LIMITS.chunk_bytes >> 20})",
    )


def limits_of(args: argparse.Namespace) -> Limits:
    """Return the limits for reading a log."""
    return replace(DEFAULT_LIMITS, chunk_bytes=args.max_chunk)


@contextmanager
def open_part(args: argparse.Namespace, logs: Sequence[Path | str]) -> Iterator[crosscue.Log]:
    """Open a drive's logs, restricted to the part that ``add_part_arguments`` selects."""
    from crosscue.replay.logs.log_part import part_in_words
    from crosscue.replay.logs.opening import unless_damaged

    with crosscue.open(*logs, limits=limits_of(args)) as log, unless_damaged(log.logs):
        part = part_in_words(log.logs, args.start, args.end, args.topics)
        yield replace(log, selection=part)


def _mebibytes(text: str) -> int:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and 0.0 < value <= 1 << 20):
        raise argparse.ArgumentTypeError(f"{text!r}: expected MiB, above 0 and up to {1 << 20}")
    return max(int(value * (1 << 20)), 1)


def add_logs_argument(parser: argparse.ArgumentParser) -> None:
    """Add ``--logs``, and ``--max-chunk`` for reading them."""
    add_limit_arguments(parser)
    parser.add_argument(
        "--logs",
        type=Path,
        metavar="DIR",
        help="folder that the run's logs have moved to; they are recognised by content",
    )


def add_logs_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--logs`` and ``--without-images``."""
    add_logs_argument(parser)
    parser.add_argument(
        "--without-images",
        action="store_true",
        help="leave out camera images, so the run's logs are not needed",
    )


def add_vehicle_output(parser: argparse.ArgumentParser) -> None:
    """Add ``-o`` and ``--overwrite``, for commands that write a fit into a vehicle file."""
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="V.toml",
        help="vehicle file to write: a copy of --vehicle with the fit; may be the same file",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace another existing file")


def refuse_existing(args: argparse.Namespace) -> None:
    """Refuse an existing output file, unless ``--overwrite`` is set.

    Raises:
        OutputError: The file exists.
    """
    if args.output is not None and args.output.exists() and not args.overwrite:
        raise OutputError(f"{args.output}: exists; give another name or --overwrite")


def metres(text: str) -> float:
    """Parse a length in metres.

    Raises:
        argparse.ArgumentTypeError: Not a finite number above 0.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r}: expected metres, above 0")
    return value


class Result(Protocol):
    """Result of a public function, printed as text or as JSON."""

    def as_dict(self) -> object:
        """Return the result as dictionaries, lists and scalars."""
        ...


def print_result(found: Result, args: argparse.Namespace) -> None:
    """Print the result as JSON (``--json``) or as text; print nothing with ``--quiet``."""
    if args.json:
        print_json(found.as_dict())
    elif not args.quiet:
        print(found)


def print_json(value: object) -> None:
    """Print strict JSON on stdout: sorted keys, NaN and infinities as null."""
    print(strict_json(value))


def warn(sentence: str) -> None:
    """Print one line on stderr, with control characters escaped."""
    print(f"crosscue: {visible(sentence)}", file=sys.stderr)


def add_schema_output(parser: argparse.ArgumentParser) -> None:
    """Add ``-o`` and ``--overwrite``, for commands that print a JSON Schema."""
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="file to write (default: print it)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace the output")


def print_schema(schema: object, args: argparse.Namespace) -> None:
    """Print a JSON Schema, or write it to the file of ``--output``.

    Raises:
        OutputError: The file exists, or cannot be written.
    """
    refuse_existing(args)
    if args.output is None:
        print_json(schema)
    else:
        write_text(args.output, strict_json(schema) + "\n")


EVERY_S: Final = 0.1
"""Shortest time between two updates of the line."""


class Done(NamedTuple):
    """Progress of a command.

    Attributes:
        amount: Amount done.
        total: Amount to do; None or 0 where unknown.
        unit: Unit of both, as a plural noun.
    """

    amount: float
    total: float | None
    unit: str


class ProgressLine:
    """Progress line of one command; a context manager, or closed by ``end``."""

    def __init__(self, what: str, *, is_shown: bool) -> None:
        """Create a line that draws nothing before the first ``at``, or unless ``is_shown``.

        Args:
            what: The text before the bar.
            is_shown: True to draw on stderr, which must then be a terminal.
        """
        self.is_shown = is_shown
        self._what = what
        self._began = time.monotonic()
        self._shown = -EVERY_S
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        self._unit = ""

    def at(self, done: Done, what: str = "") -> None:
        """Show the progress; ``what`` replaces the text before the bar, for another stage."""
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
        # Nothing is drawn before the first progress.
        bar.start()

    def counting(self, unit: str, per: float = 1.0) -> Callable[[float, float | None], None]:
        """Return a callback for the amount done and the total, in 1/``per`` of the shown unit."""

        def count(done: float, of: float | None) -> None:
            self.at(Done(done / per, None if of is None else of / per, unit))

        return count

    def end(self) -> None:
        """Remove the line."""
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
    """Progress line of one drive: frames while detectors run, then seconds of the log."""

    def at_frame(self, done: int, of: int | None) -> None:
        """Show the number of frames done."""
        self.at(Done(done, of, "frames"), "detecting")

    def at_time(self, done_s: float, of_s: float) -> None:
        """Show the seconds of the log that are done."""
        self.at(Done(done_s, of_s, "s of log"))


class DrivesLine(ProgressLine):
    """Progress line of many drives."""

    def __call__(self, at: Progressed) -> None:
        """Show the number of drives done."""
        failed = f", {at.failed} failed" if at.failed else ""
        self.at(Done(at.done, at.total - at.earlier, "drives"), f"{self._what}{failed}")


def is_shown(args: argparse.Namespace) -> bool:
    """Return True unless ``--quiet`` is set or stderr is not a terminal."""
    return not args.quiet and sys.stderr.isatty()


def progress_line(args: argparse.Namespace, what: str) -> ProgressLine:
    """Return the progress line of a command with these arguments."""
    return ProgressLine(what, is_shown=is_shown(args))


def with_progress(
    items: Iterable[T], done: Callable[[], Done], args: argparse.Namespace, what: str
) -> Iterator[T]:
    """Yield ``items`` and, on a terminal, show a progress line with rate and time left.

    Args:
        items: The items to process.
        done: Returns the progress; called after each item.
        args: Arguments of the command, with ``quiet``.
        what: The text before the bar.
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
        # Results are printed on stdout during the work; rich would redirect them to stderr.
        redirect_stdout=False,
        redirect_stderr=False,
    )
