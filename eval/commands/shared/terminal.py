"""Shared options of the commands that are written by hand."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar

from crosscue.eval.command_line import add_parameters
from crosscue.eval.terminal import Done as Done
from crosscue.eval.terminal import ProgressLine as ProgressLine
from crosscue.eval.terminal import is_shown
from crosscue.eval.terminal import warn as warn
from crosscue.replay import limits
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.limits import Limits

if TYPE_CHECKING:
    pass

T = TypeVar("T")


def add_limit_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--max-chunk`` and ``--follow-links``."""
    add_parameters(parser, limits.limits_of)


def limits_of(args: argparse.Namespace) -> Limits:
    """Return the limits for reading a log."""
    return limits.limits_of(max_chunk_bytes=args.max_chunk_bytes, follow_links=args.follow_links)


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


class Result(Protocol):
    """Result of a public function, printed as text or as JSON."""

    def as_dict(self) -> object:
        """Return the result as dictionaries, lists and scalars."""
        ...


def print_result(found: Result, args: argparse.Namespace) -> None:
    """Print the result as JSON (``--json``) or as text; print nothing with ``--quiet``."""
    if args.json:
        print(strict_json(found.as_dict()))
    elif not args.quiet:
        print(found)


def progress_line(args: argparse.Namespace, what: str) -> ProgressLine:
    """Return the progress line of a command with these arguments."""
    return ProgressLine(what, is_shown=is_shown(args))
