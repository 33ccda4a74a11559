"""Choose the match threshold for a required false-match rate, from labelled pictures.

The threshold is chosen on half of the query pictures, and the rates are measured on the other half.
Pairs are read from a CSV file with the columns query, known (paths relative to the file's folder)
and same (1 or 0), or are made from a drive with known poses and a database from another drive.

example:
  crosscue fit landmarks --pairs pairs.csv --false-match-rate 0.01
  crosscue fit landmarks second.mcap --database town.sqlite --poses truth.json \
--vehicle car.toml -o car.toml
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import (
    add_part_arguments,
    add_vehicle_output,
    metres,
    part_of,
    print_result,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("logs", nargs="*", type=Path, metavar="LOG", help="recordings of one drive")
    parser.add_argument("--pairs", type=Path, metavar="FILE.csv", help="labelled pairs of images")
    parser.add_argument(
        "--database", type=Path, metavar="DB", help="landmark database made from another drive"
    )
    parser.add_argument(
        "--poses",
        type=Path,
        metavar="RUN|T.json",
        help="poses of the vehicle: a run or a truth file",
    )
    parser.add_argument(
        "--false-match-rate",
        type=_fraction,
        default=0.001,
        metavar="P",
        help="max fraction of pairs from different places that may match (default: 0.001)",
    )
    for flag, default, what in (
        ("--every", 5.0, "distance between the frames used, in metres"),
        ("--same-within", 5.0, "max distance of a landmark of the same place, in metres"),
        ("--different-beyond", 50.0, "min distance of a landmark of another place, in metres"),
    ):
        parser.add_argument(
            flag, type=metres, default=default, metavar="M", help=f"{what} (default: {default:g})"
        )
    parser.add_argument(
        "--max-landmarks",
        type=int,
        default=50,
        metavar="N",
        help="max landmarks per frame (default: 50)",
    )
    parser.add_argument(
        "--vehicle", type=Path, metavar="V.toml", help="vehicle file: camera and matcher"
    )
    parser.add_argument("--matcher", metavar="NAME", help="orb, or your own module:factory")
    add_vehicle_output(parser)
    add_part_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def _fraction(text: str) -> float:
    value = float(text)
    if not 0.0 <= value < 1.0:
        raise ValueError(text)
    return value


def run(args: argparse.Namespace) -> int:
    """Fit, report, and write the vehicle file if requested."""
    found = crosscue.fit_landmarks(
        args.pairs,
        part_of(args, args.logs) if args.logs else None,
        args.database,
        args.poses,
        args.vehicle,
        args.output,
        false_match_rate=args.false_match_rate,
        every_m=args.every,
        same_within_m=args.same_within,
        different_beyond_m=args.different_beyond,
        max_landmarks=args.max_landmarks,
        matcher=args.matcher,
        overwrite=args.overwrite,
    )
    print_result(found, args)
    return 0
