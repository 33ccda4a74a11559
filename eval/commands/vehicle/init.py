"""Write a first vehicle file from what a log holds.

example:
  crosscue vehicle init drive.mcap --dbc car.dbc -o car.toml
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crosscue.eval.commands.shared.options import (
    add_limit_arguments,
    limits_of,
    print_json,
    refuse_existing,
)
from crosscue.replay.base import write_text
from crosscue.replay.opening import open_logs
from crosscue.replay.vehicle.draft import draft
from crosscue.replay.vehicle.vehicle import parse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="recordings of one drive")
    parser.add_argument(
        "--dbc",
        nargs="+",
        type=Path,
        default=[],
        metavar="FILE",
        help="DBC, KCD, ARXML or SYM files of the CAN buses",
    )
    add_limit_arguments(parser)
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="V.toml",
        help="vehicle file to write (default: print it)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Draft the file, check that it reads back, write or print it."""
    refuse_existing(args)
    folder = args.output.parent if args.output is not None else Path.cwd()
    with open_logs(args.logs, limits_of(args)) as logs:
        text = draft(logs, args.dbc, folder)
    parse(text, "the draft")
    if args.output is not None:
        write_text(args.output, text)
    if args.json:
        print_json({"vehicle": None if args.output is None else str(args.output), "text": text})
    elif args.output is None:
        print(text, end="")
    elif not args.quiet:
        print(args.output)
    return 0
