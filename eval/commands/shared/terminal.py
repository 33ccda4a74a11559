"""Shared options of the commands that are written by hand."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar

import crosscue
from crosscue.eval.command_line import add_parameters
from crosscue.eval.terminal import Done as Done
from crosscue.eval.terminal import ProgressLine as ProgressLine
from crosscue.eval.terminal import is_shown
from crosscue.eval.terminal import print_json as print_json
from crosscue.eval.terminal import warn as warn
from crosscue.replay import limits
from crosscue.replay.base import (
    Limits,
    OutputError,
)

if TYPE_CHECKING:
    pass

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
    """Add ``--max-chunk`` and ``--follow-links``."""
    add_parameters(parser, limits.limits_of)


def limits_of(args: argparse.Namespace) -> Limits:
    """Return the limits for reading a log."""
    return limits.limits_of(max_chunk_bytes=args.max_chunk_bytes, follow_links=args.follow_links)


def part_of(args: argparse.Namespace, logs: Sequence[Path | str]) -> crosscue.UnopenedLog:
    """Return a drive's logs with the part that ``add_part_arguments`` selects, not open yet."""
    from crosscue.replay.logs.log_part import LogPart

    return crosscue.UnopenedLog(
        tuple(logs), LogPart(args.start, args.end, args.topics), limits_of(args)
    )


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
