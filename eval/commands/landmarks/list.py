"""List all landmarks of a database, or those near a place.

example:
  crosscue landmarks list town.sqlite --near=-12.5,80,50
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("database", type=Path, metavar="DB", help="landmark database")
    parser.add_argument(
        "--near",
        metavar="X,Y,R",
        help="only landmarks within R metres of a place; --near=-5,3,10 for x < 0",
    )
    parser.add_argument(
        "--limit", type=int, default=100, metavar="N", help="max landmarks to list (default: 100)"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """List the landmarks."""
    print_result(crosscue.list_landmarks(args.database, args.near, args.limit), args)
    return 0
