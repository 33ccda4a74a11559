"""Check a vehicle file on part of a drive: list the values of each signal, and contradictions.

The page shows a picture with the horizon, distances along the road, and the regions searched for
road. The exit status is 1 when signals contradict each other.

example:
  crosscue vehicle check drive.mcap --vehicle car.toml -o check.html
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import (
    add_file_output,
    add_limit_arguments,
    limits_of,
    print_result,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="recordings of one drive")
    parser.add_argument(
        "--vehicle", type=Path, required=True, metavar="V.toml", help="the vehicle file to check"
    )
    parser.add_argument(
        "--start-s",
        type=float,
        default=0.0,
        metavar="S",
        help="start this many seconds after the first message",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=10.0,
        metavar="S",
        help="seconds of the log to read (default: 10)",
    )
    add_limit_arguments(parser)
    add_file_output(parser, "FILE", "page (.html) or picture (.jpg, .png) to write")


def run(args: argparse.Namespace) -> int:
    """Check and print the table; return 1 when signals contradict each other."""
    found = crosscue.check_vehicle(
        crosscue.UnopenedLog((*args.logs,), limits=limits_of(args)),
        args.vehicle,
        args.output,
        start_s=args.start_s,
        seconds=args.seconds,
        overwrite=args.overwrite,
    )
    print_result(found, args)
    return 1 if found.contradictions else 0
