"""Decode a drive into tables: one Parquet file per topic, CAN message and Mobileye table.

example:
  crosscue decode drive.mcap --vehicle car.toml -o tables
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import (
    add_log_arguments,
    open_part,
    print_result,
    progress_line,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    add_log_arguments(parser)
    parser.add_argument(
        "-o", "--output", required=True, type=Path, metavar="DIR", help="folder for the tables"
    )
    parser.add_argument(
        "--vehicle", type=Path, metavar="V.toml", help="vehicle file: DBC files, buses, mounting"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace existing tables")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Decode; return 3 when something was dropped or the clock has gaps."""
    with open_part(args, args.logs) as log, progress_line(args, "decoding") as line:
        found = crosscue.decode(
            log,
            args.output,
            args.vehicle or crosscue.Vehicle(version=1),
            overwrite=args.overwrite,
            on_rows=line.counting("rows"),
        )
    print_result(found, args)
    return found.exit_status
