"""Merge the runs of several batches into one folder of tables, with the drive's name in each row.

The result is a set union: the order does not matter, and a run that is in two batches counts once.
Two different runs of the same name are refused. A single batch over all drives yields the same
bytes.

example:
  crosscue merge shards/1 shards/2 -o all
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument(
        "folders", nargs="+", type=Path, metavar="RUNS", help="folders of runs, or run folders"
    )
    parser.add_argument(
        "-o", "--output", required=True, type=Path, metavar="ALL", help="folder for the tables"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace existing tables")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Merge; return 3 when a drive of a batch has failed."""
    found = crosscue.merge(args.folders, args.output, overwrite=args.overwrite)
    print_result(found, args)
    return 3 if found.failures else 0
