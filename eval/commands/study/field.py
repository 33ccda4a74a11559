"""Simulate the field protocol: drives to successive goals in a 1 km2 town, written as logs.

There are 33 range runs without landmarks, and 10 runs with at most one landmark at a time. Each
lasts up to 75 minutes, with a compass of 25 degrees. Each run is a log, a vehicle file and a truth
file, replayed and scored by the same code as a real drive; crosscue view shows it. An interrupted
study continues with the missing runs. A run takes between seconds and a minute to compute.

examples:
  crosscue study field -o field
  crosscue study field --range-runs 4 --landmark-runs 2 --minutes 20 -o field
  crosscue replay field/range_000/drive.mcap --vehicle field/range_000/vehicle.toml -o again
"""

from __future__ import annotations

import argparse

import crosscue
from crosscue.eval.commands.shared.study import add_study_arguments, study_of, workers_of
from crosscue.eval.commands.shared.terminal import print_json, progress_line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    add_study_arguments(parser, "study-field")
    parser.add_argument("--range-runs", type=int, metavar="N", help="runs without landmarks")
    parser.add_argument("--landmark-runs", type=int, metavar="N", help="runs with landmarks")
    parser.add_argument(
        "--minutes", type=float, metavar="M", help="max duration of a run, in minutes"
    )


def run(args: argparse.Namespace) -> int:
    """Simulate, replay, score and report."""
    study = study_of(args, crosscue.FieldStudy)
    with progress_line(args, "driving and replaying") as line:
        found = crosscue.run_field_study(
            study,
            args.output,
            workers_of(args),
            overwrite=args.overwrite,
            on_percent=line.counting("percent"),
        )
    if args.json:
        print_json(found.as_dict())
    elif not args.quiet:
        print(f"{found}\n\npage       {found.page}")
    return 0 if found.is_whole else 3
