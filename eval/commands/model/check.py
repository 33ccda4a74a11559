"""Check a model card by running its network, and draw the detections in a picture.

example:
  crosscue model check my.toml --picture street.jpg
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("model", metavar="MODEL", help="name in the catalog, or model card")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="run it on this picture")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FILE.jpg",
        help="picture with detections to write (default: CARD.PICTURE.found.jpg)",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Check the card."""
    print_result(crosscue.check_card(args.model, args.picture, args.output), args)
    return 0
