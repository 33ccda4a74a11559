"""List the detectors, cues, readers and data sets that installed packages add to crosscue.

A package registers them as entry points in the groups crosscue.detectors, crosscue.cues,
crosscue.readers and crosscue.datasets. The exit status is 1 when a plug-in does not load.

example:
  crosscue plugins
"""

from __future__ import annotations

import argparse
from dataclasses import asdict

import crosscue
from crosscue.eval.commands.shared.terminal import print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """List the plug-ins; return 1 when one does not load."""
    found = crosscue.plugins()
    if args.json:
        print_json({"plugins": [asdict(one) for one in found]})
    elif not args.quiet:
        print(found if len(found) else "no plug-in is installed")
    return 1 if any(one.problem for one in found) else 0
