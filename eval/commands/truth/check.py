"""Check that a truth file, and every file that it names, fits its log.

The check fails for times outside the log, unknown cues or classes, overlapping approaches, boxes
outside the picture, pictures of another size, and the hash of another log.

example:
  crosscue truth check truth.json --log drive.mcap
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import add_limit_arguments, limits_of, print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("truth", type=Path, metavar="T.json", help="truth file")
    parser.add_argument(
        "--log", type=Path, required=True, metavar="LOG", help="log that the truth belongs to"
    )
    parser.add_argument("--vehicle", type=Path, metavar="V.toml", help="vehicle file: camera topic")
    add_limit_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Check the truth, and print its contents."""
    found = crosscue.check_truth(args.truth, args.log, args.vehicle, limits=limits_of(args))
    print_result(found, args)
    return 0
