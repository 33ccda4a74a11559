"""List the models of the catalog.

example:
  crosscue model list
"""

from __future__ import annotations

import argparse

import crosscue
from crosscue.eval.commands.shared.terminal import print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """List the models."""
    print_result(crosscue.models(), args)
    return 0
