"""Show a model: its origin, the mapping of its classes to cue labels, and its measured performance.

example:
  crosscue model show yolox-nano
  crosscue model show my.toml --json
"""

from __future__ import annotations

import argparse

import crosscue
from crosscue.eval.commands.shared.terminal import print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("model", metavar="MODEL", help="name in the catalog, or model card")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Show the model."""
    print_result(crosscue.model(args.model), args)
    return 0
