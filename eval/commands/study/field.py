"""Simulate the field protocol: successive goals in a 1 km2 town, through logs and the replay.

33 range runs without landmarks and 10 with at most one landmark at a time, 75 minutes each, compass
at 25 degrees. Every run is a log, a vehicle file and a truth file, replayed and scored by the same
code as a real drive; view one with crosscue view. An interrupted study continues with the missing
runs. A run takes seconds to a minute.

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
    """Declare flags."""
    add_study_arguments(parser, "study-field")
    parser.add_argument("--range-runs", type=int, metavar="N", help="runs without landmarks")
    parser.add_argument("--landmark-runs", type=int, metavar="N", help="runs with landmarks")
    parser.add_argument(
        "--minutes", type=float, metavar="M", help="max duration of a run, in minutes"
    )


def run(args: argparse.Namespace) -> int:
    """Drive, replay, score, report."""
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
