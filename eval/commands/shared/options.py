"""What several commands share: which logs, which part of them, and how results are printed."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from crosscue.replay.base import (
    DEFAULT_LIMITS,
    Limits,
    OutputError,
    strict_json,
    write_text,
)


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
