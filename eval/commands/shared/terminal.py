"""What commands share: options, how results are printed, and one line of progress.

The line says how much is done, how fast, and how long still. rich draws it, on stderr, and removes
it at the end; where stderr is not a terminal, or with ``--quiet``, rich is not imported.
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
    """``LOG...``, ``--from``, ``--to`` and ``--topics``."""
    parser.add_argument(
        "logs", nargs="+", metavar="LOG", help="recordings of one drive; paths or URLs"
    )
    add_part_arguments(parser)


def add_part_arguments(parser: argparse.ArgumentParser) -> None:
    """``--from``, ``--to`` and ``--topics``."""
    parser.add_argument(
        "--from",
        dest="start",
        metavar="T",
        help="start time: seconds from the first message (12.5) or absolute nanoseconds (17...ns)",
    )
    parser.add_argument(
        "--to", dest="end", metavar="T", help="end time, exclusive, in the same form"
    )
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="read only these topics")
    add_limit_arguments(parser)


def add_first_pose_arguments(parser: argparse.ArgumentParser, default: str) -> None:
    """Declare ``--gnss`` and ``--start``."""
    parser.add_argument(
        "--gnss",
        choices=("start", "truth", "fuse", "off"),
        help="what GNSS is for: the first pose and heading, truth alone, the first pose and every "
        f"position after it, or nothing (default: {default})",
    )
    parser.add_argument(
        "--start",
        dest="first_pose",
        metavar="POSE",
        help="first pose: X,Y,HEADING in metres and degrees counter-clockwise from east, or a "
        "truth file with a track",
    )


def add_annotated_runs(parser: argparse.ArgumentParser) -> None:
    """``RUN...`` and ``--truth``, one for each."""
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
    """``--truth`` and ``--any-log``, for runs that have a truth each."""
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="T.json",
        help="truth of all runs (default: truth.json beside each run's log)",
    )
    parser.add_argument(
        "--any-log",
        action="store_true",
        help="accept truth made for another file of the same drive, such as a converted log",
    )


def add_choice_of_failures(parser: argparse.ArgumentParser) -> None:
    """``--top`` and ``--threshold``."""
    parser.add_argument(
        "--top",
        type=int,
        metavar="N",
        help="only N failures, of as many causes and runs as possible (default: all)",
    )
    parser.add_argument(
        "--threshold",
        type=float,
        default=0.9,
        metavar="P",
        help="a feature is believed above this probability (default: 0.9)",
    )


def add_file_output(parser: argparse.ArgumentParser, metavar: str, what: str) -> None:
    """``-o``, ``--overwrite`` and ``--json`` of a command that writes one file."""
    parser.add_argument("-o", "--output", type=Path, metavar=metavar, help=what)
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def add_limit_arguments(parser: argparse.ArgumentParser) -> None:
    """``--max-chunk``."""
    parser.add_argument(
        "--max-chunk",
        type=_mebibytes,
        default=DEFAULT_LIMITS.chunk_bytes,
        metavar="MIB",
        help="largest chunk, container or page to decompress, in MiB "
        f"(default: {DEFAULT_LIMITS.chunk_bytes >> 20})",
    )


def limits_of(args: argparse.Namespace) -> Limits:
    """The limits that a log is read with."""
    return replace(DEFAULT_LIMITS, chunk_bytes=args.max_chunk)


@contextmanager
def open_part(args: argparse.Namespace, logs: Sequence[Path | str]) -> Iterator[crosscue.Log]:
    """The drive, open, of which only the part is read that ``add_part_arguments`` asks for."""
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
    """``--logs``, and ``--max-chunk`` for reading them."""
    add_limit_arguments(parser)
    parser.add_argument(
        "--logs",
        type=Path,
        metavar="DIR",
        help="folder that the run's logs have moved to; they are recognised by content",
    )


def add_logs_arguments(parser: argparse.ArgumentParser) -> None:
    """``--logs`` and ``--without-images``."""
    add_logs_argument(parser)
    parser.add_argument(
        "--without-images",
        action="store_true",
        help="leave out camera images, so the run's logs are not needed",
    )


def add_vehicle_output(parser: argparse.ArgumentParser) -> None:
    """``-o`` and ``--overwrite`` of a command that writes its fit into a vehicle file."""
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="V.toml",
        help="vehicle file to write: --vehicle with the fit; may be the same file",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace another existing file")


def refuse_existing(args: argparse.Namespace) -> None:
    """Refuse an output that exists, without ``--overwrite``.

    Raises:
        OutputError: It exists.
    """
    if args.output is not None and args.output.exists() and not args.overwrite:
        raise OutputError(f"{args.output}: exists; give another name or --overwrite")


def metres(text: str) -> float:
    """A length from the command line.

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
    """What a function of the interface returns: printed as text, or as JSON."""

    def as_dict(self) -> object:
        """Dictionaries, lists and scalars."""
        ...


def print_result(found: Result, args: argparse.Namespace) -> None:
    """The result, as ``--json`` or as it prints itself; nothing with ``--quiet``."""
    if args.json:
        print_json(found.as_dict())
    elif not args.quiet:
        print(found)


def print_json(value: object) -> None:
    """Strict JSON on stdout: sorted keys, NaN and infinities as null."""
    print(strict_json(value))


def warn(sentence: str) -> None:
    """One line on stderr, what would harm a terminal as escapes."""
    print(f"crosscue: {visible(sentence)}", file=sys.stderr)


def add_schema_output(parser: argparse.ArgumentParser) -> None:
    """``-o`` and ``--overwrite`` of commands that print a JSON Schema."""
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: print it")
    parser.add_argument("--overwrite", action="store_true", help="replace the output")


def print_schema(schema: object, args: argparse.Namespace) -> None:
    """A JSON Schema to stdout, or whole into the file of ``--output``.

    Raises:
        OutputError: The file exists, or cannot be written.
    """
    refuse_existing(args)
    if args.output is None:
        print_json(schema)
    else:
        write_text(args.output, strict_json(schema) + "\n")


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
