"""Fit scales, biases, delays and noise of odometry to half of a drive, and test them on the rest.

The reference positions are the log's GNSS or, with --truth, a true track. Parameters that the drive
does not determine keep their values and are listed. For example, a straight drive determines
neither the gyro's scale nor the steering ratio.

examples:
  crosscue fit odometry drive.mcap --vehicle car.toml -o car.toml
  crosscue fit odometry drive.mcap --vehicle car.toml --truth truth/ -o car.toml
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
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="T.json",
        help="truth file with the true track, or its folder (default: the log's GNSS)",
    )
    add_vehicle_output(parser)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Fit, test, report, and write the vehicle file if requested."""
    found = crosscue.fit_odometry(
        part_of(args, args.logs),
        args.vehicle,
        args.output,
        truth=args.truth,
        overwrite=args.overwrite,
    )
    print_result(found, args)
    return 0
