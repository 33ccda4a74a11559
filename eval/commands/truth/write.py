"""Write the truth that a data set contains: truth.json and a TUM trajectory.

example:
  crosscue truth comma2k19/Example_1/ROUTE/40 -o truth/
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import add_limit_arguments, limits_of, print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("log", type=Path, metavar="LOG", help="folder of a data set")
    add_limit_arguments(parser)
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        type=Path,
        metavar="DIR",
        help="folder for the truth file and its trajectory",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Write truth.json."""
    written = crosscue.write_truth(args.log, args.output, limits=limits_of(args))
    if args.json:
        print_json({"truth": str(written)})
    elif not args.quiet:
        print(written)
    return 0
