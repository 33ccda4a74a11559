"""Measure the range without landmarks: 4,000 simulated drives, with three compasses and with none.

Each drive goes from goal to goal until its 2-sigma ellipse is longer than 100 m. Results are shown
next to the published ones. An interrupted study continues where it stopped. The result does not
depend on the number of workers.

examples:
  crosscue study range -o range
  crosscue study range --drives 50 --workers 2
  crosscue study range --settings my_car.toml -o mine
  crosscue study range --calibrate
"""

from __future__ import annotations

import argparse

import crosscue
from crosscue.eval.commands.shared.study import (
    add_cluster_arguments,
    add_study_arguments,
    print_study,
    study_of,
    workers_of,
)
from crosscue.eval.commands.shared.terminal import print_json, progress_line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    add_study_arguments(parser, "study-range")
    add_cluster_arguments(parser)
    parser.add_argument(
        "--calibrate",
        action="store_true",
        help="find the compass interval that yields the published 9.3 km at 30 degrees, with "
        "separate seeds, instead of running the study",
    )


def run(args: argparse.Namespace) -> int:
    """Run the study, or calibrate the compass interval."""
    study = study_of(args, crosscue.RangeStudy)
    if args.calibrate:
        interval_m = crosscue.calibrate_study(study, workers_of(args))
        if args.json:
            print_json({"compass_interval_m": interval_m})
        else:
            print(f"[drive.sensors]\ncompass_interval_m = {interval_m:.4f}")
        return 0
    with progress_line(args, "driving") as line:
        found = crosscue.run_study(
            study,
            args.output,
            workers_of(args),
            ray=args.ray,
            overwrite=args.overwrite,
            on_percent=line.counting("percent"),
        )
    print_study(found, args)
    return 0
