"""Write the truth that a data set carries: truth.json and a TUM trajectory.

example:
  crosscue truth comma2k19/Example_1/ROUTE/40 -o truth/
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crosscue.datasets.truth.truth import json_schema, write_carried
from crosscue.eval.commands.shared.options import add_limit_arguments, limits_of, print_json
from crosscue.replay.errors import UsageError
from crosscue.replay.opening import open_log


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("log", nargs="?", type=Path, metavar="LOG", help="a data set's folder")
    add_limit_arguments(parser)
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="where to write it")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.add_argument("--schema", action="store_true", help="print truth.json's JSON Schema")


def run(args: argparse.Namespace) -> int:
    """Write truth.json, or print its schema."""
    if args.schema:
        print_json(json_schema())
        return 0
    if args.log is None or args.output is None:
        raise UsageError("truth: give a LOG and -o DIR, or --schema")
    with open_log(args.log, limits_of(args)) as log:
        written = write_carried(log.format, args.log, args.output)
    if args.json:
        print_json({"truth": str(written)})
    elif not args.quiet:
        print(written)
    return 0
