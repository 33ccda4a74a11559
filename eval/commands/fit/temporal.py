"""Learn the belief over time from annotated drives, for fusion.kind = "temporal".

Give finished runs and the truth of each, in the same order, drives without an intersection among
them. What is learned (how each cue behaves from step to step, by distance, where a road is and
where it is not) goes into the vehicle file's section [fusion.temporal].

example:
  crosscue fit temporal runs/* --truth drives/*/truth.json -o temporal.toml
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import print_result, progress_line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run folders")
    parser.add_argument(
        "--truth",
        nargs="+",
        required=True,
        type=Path,
        metavar="T.json",
        help="truth of each run, in the same order",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="TOML",
        help="file to write the section to (default: print it)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Learn and report."""
    with progress_line(args, "reading") as line:
        found = crosscue.fit_temporal(
            args.runs,
            args.truth,
            args.output,
            overwrite=args.overwrite,
            on_runs=line.counting("runs"),
        )
    print_result(found, args)
    return 0
