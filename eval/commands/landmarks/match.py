"""Match one picture against all landmarks of a database, or those near a place.

example:
  crosscue landmarks match town.sqlite photo.jpg --near 120,80,50
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("database", type=Path, metavar="DB", help="landmark database")
    parser.add_argument("image", type=Path, metavar="IMAGE", help="PNG, JPEG or WebP")
    parser.add_argument(
        "--near",
        metavar="X,Y,R",
        help="only landmarks within R metres of a place; --near=-5,3,10 for x < 0",
    )
    parser.add_argument(
        "--best", type=int, default=5, metavar="N", help="number of matches to show (default: 5)"
    )
    parser.add_argument(
        "--vehicle", type=Path, metavar="V.toml", help="vehicle file: camera and matcher"
    )
    parser.add_argument("--matcher", metavar="NAME", help="orb, or your own module:factory")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Match the picture."""
    found = crosscue.match_landmarks(
        args.database,
        args.image,
        args.vehicle,
        near=args.near,
        best=args.best,
        matcher=args.matcher,
    )
    print_result(found, args)
    return 0
