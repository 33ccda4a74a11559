"""Write failures as a static site, which needs no server: pictures, belief curves, filters.

RUN is a run folder, a folder of runs, or a table from crosscue failures. Open index.html in a
browser. Each failure is shown with its picture (with boxes, masks and regions), the belief around
that time, and the command that opens Rerun at that time.

examples:
  crosscue browse runs -o site
  crosscue browse worst.parquet -o site --recordings
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import (
    add_choice_of_failures,
    add_logs_argument,
    add_truth_of_runs,
    limits_of,
    print_result,
    progress_line,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument(
        "runs", nargs="+", metavar="RUN", help="run folders, folders of them, or a table"
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the site"
    )
    add_truth_of_runs(parser)
    add_logs_argument(parser)
    add_choice_of_failures(parser)
    parser.add_argument(
        "--recordings",
        action="store_true",
        help="also write a recording of each failure, of some megabytes each",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing site")
    parser.add_argument(
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="number of runs in parallel (default: 1)",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Write the site; return 3 when a run could not be examined."""
    with progress_line(args, "drawing") as line:
        made = crosscue.browse(
            args.runs,
            args.output,
            truth=args.truth,
            top=args.top,
            threshold=args.threshold,
            any_log=args.any_log,
            logs=args.logs,
            limits=limits_of(args),
            has_recordings=args.recordings,
            overwrite=args.overwrite,
            workers=args.workers,
            on_runs=line.counting("runs"),
        )
    print_result(made, args)
    return 0 if made.is_whole else 3
