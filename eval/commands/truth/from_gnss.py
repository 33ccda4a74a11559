"""Write a drive's GNSS positions as its truth, with their standard deviations.

The track is that of the antenna. Scores of poses take into account the receiver's standard
deviation (or gnss.position_sd_m of the vehicle file) and gnss.course_sd_rad. Positions before the
car first moves have no heading and are omitted.

example:
  crosscue truth from-gnss drive.mcap --vehicle car.toml -o truth/
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import add_log_arguments, part_of, print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    add_log_arguments(parser)
    parser.add_argument("--vehicle", type=Path, metavar="V.toml", help="vehicle file")
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        type=Path,
        metavar="DIR",
        help="folder for the truth file and its track",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Write truth.json."""
    written = crosscue.truth_from_gnss(part_of(args, args.logs), args.output, args.vehicle)
    if args.json:
        print_json({"truth": str(written)})
    elif not args.quiet:
        print(written)
    return 0
