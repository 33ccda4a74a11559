"""List the failures of runs, worst first, by kind, by feature or cue, and by cause.

There are five kinds: a feature or cue that exists and was missed; a feature believed only within
8 m of the intersection (late); a feature believed, or a cue found, that does not exist (false); a
range outside its 95 % interval; and a belief that was decided and then flipped. Without truth, only
the last kind can be detected. Severity is in bits; docs/howto/failures.md explains it. --top picks
the worst failure of every cause and run before a second one of any.

examples:
  crosscue failures runs
  crosscue failures runs --top 20 -o worst.parquet
  crosscue failures runs --where "'dusk' in conditions"
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import (
    add_choice_of_failures,
    add_truth_of_runs,
    print_result,
    progress_line,
    refuse_existing,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folders, or folders of them")
    parser.add_argument(
        "--where", metavar="QUERY", help="only runs that this query selects; RUN is then one folder"
    )
    add_truth_of_runs(parser)
    add_choice_of_failures(parser)
    parser.add_argument(
        "-o", "--output", type=Path, metavar="TABLE", help="table to write: .parquet or .json"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing table")
    parser.add_argument(
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="number of runs in parallel (default: 1)",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Find and print failures; return 3 when a run could not be examined."""
    refuse_existing(args)
    runs = args.runs
    if args.where is not None:
        if len(runs) != 1:
            raise crosscue.UsageError("--where: expected one folder of runs to select from")
        runs = crosscue.catalog(runs[0]).select(args.where)
        if not runs:
            raise crosscue.EmptyResultError(f"{args.runs[0]}: no run where {args.where}")
    with progress_line(args, "examining") as line:
        found = crosscue.failures(
            runs,
            truth=args.truth,
            output=args.output,
            top=args.top,
            threshold=args.threshold,
            any_log=args.any_log,
            workers=args.workers,
            on_runs=line.counting("runs"),
        )
    print_result(found, args)
    return 3 if found.failed else 0
