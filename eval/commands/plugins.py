"""What installed packages add to crosscue: detectors, cues, readers and data sets.

A package offers them as entry points of the groups crosscue.detectors, crosscue.cues,
crosscue.readers and crosscue.datasets. Exit status 1 when one does not load.

example:
  crosscue plugins
"""

from __future__ import annotations

import argparse
from dataclasses import asdict

import crosscue
from crosscue.eval.commands.shared.terminal import print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """List; 1 when one does not load."""
    found = crosscue.plugins()
    if args.json:
        print_json({"plugins": [asdict(one) for one in found]})
    elif not args.quiet:
        print(found if len(found) else "no plug-in is installed")
    return 1 if any(one.problem for one in found) else 0
