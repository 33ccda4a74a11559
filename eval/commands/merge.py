"""Merge the runs of batches into one folder of tables, each row with its drive's name.

The result is a set union: the order does not matter, and a run that is in two batches counts once.
Two different runs of one name are refused. It is the same, byte for byte, as that of one batch over
all the drives.

example:
  crosscue merge shards/1 shards/2 -o all
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crosscue.eval.batch.merge import gathered, merge_runs
from crosscue.eval.commands.shared.options import print_json
from crosscue.eval.runs.folder import create
from crosscue.replay.errors import RunError
from crosscue.replay.safe_text import visible


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument(
        "folders", nargs="+", type=Path, metavar="RUNS", help="folders of runs, or run folders"
    )
    parser.add_argument(
        "-o", "--output", required=True, type=Path, metavar="ALL", help="folder for the tables"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace existing tables")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Merge; 3 when a drive of a batch has failed."""
    runs, failures = gathered(args.folders)
    if not runs:
        raise RunError(f"{args.folders[0]}: no finished run in it; replay first")
    merged = merge_runs(runs, create(args.output, overwrite=args.overwrite), failures)
    if args.json:
        print_json(
            {
                "merged": str(merged.run.path),
                "drives": sorted(runs),
                "failures": failures,
                "rows": merged.rows,
            }
        )
    elif not args.quiet:
        failed = [f"failed   {name}: {why}" for name, why in sorted(failures.items())]
        lines = [
            *failed,
            f"drives   {merged.drives}, {len(failures)} failed",
            f"tables   {merged.run.path}",
        ]
        print("\n".join(visible(line) for line in lines))
    return 3 if failures else 0
