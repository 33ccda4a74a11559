"""Show a model: its origin, what its classes mean to the cues, and its measurements.

example:
  crosscue model show yolox-nano
  crosscue model show my.toml --json
"""

from __future__ import annotations

import argparse

import crosscue
from crosscue.eval.commands.shared.terminal import print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("model", metavar="MODEL", help="a catalog's name or a card's file name")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Show."""
    print_result(crosscue.model(args.model), args)
    return 0
