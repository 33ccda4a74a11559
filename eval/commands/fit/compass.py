"""Fit a compass to a drive: its mounting angle, and hard and soft iron.

The reference is the GNSS course. Parameters that the drive does not determine keep their values and
are listed. For example, a straight drive determines only the mounting angle.

example:
  crosscue fit compass drive.mcap --vehicle car.toml -o car.toml
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import (
    add_log_arguments,
    add_vehicle_output,
    part_of,
    print_result,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    add_log_arguments(parser)
    parser.add_argument("--vehicle", type=Path, metavar="V.toml", help="vehicle file")
    add_vehicle_output(parser)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Fit, report, and write the vehicle file if requested."""
    found = crosscue.fit_compass(
        part_of(args, args.logs), args.vehicle, args.output, overwrite=args.overwrite
    )
    print_result(found, args)
    return 0
