"""Estimate pose, cues, ranges and beliefs of a run again, from its stored detections.

Pictures are not read, so other settings can be tried in seconds. The run's tables are replaced.

example:
  crosscue estimate runs/drive --vehicle other.toml
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import (
    DriveLine,
    add_first_pose_arguments,
    add_logs_argument,
    is_shown,
    limits_of,
    print_result,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder")
    parser.add_argument(
        "--vehicle",
        type=Path,
        metavar="V.toml",
        help="vehicle file with other settings (default: those of the run)",
    )
    add_first_pose_arguments(parser, "as in the run")
    add_logs_argument(parser)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Estimate; return 3 when something was dropped."""
    run = crosscue.open_run(args.run, args.logs, limits=limits_of(args))
    with DriveLine("estimating", is_shown=is_shown(args)) as line:
        made = crosscue.estimate_run(
            run, args.vehicle, gnss=args.gnss, start=args.first_pose, on_time=line.at_time
        ).made
    print_result(made, args)
    return made.exit_status
