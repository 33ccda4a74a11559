"""Measure the success rate of 3 strategies with landmarks: 52,500 simulated drives.

The study has 700 drives for each of 5 landmark densities and 5 detection rates. It reports the
success rate by distance to the goal, the range at 80 % success, and how much farther the strategies
drive, next to the published numbers. An interrupted study continues where it stopped. The result
does not depend on the number of workers.

examples:
  crosscue study landmarks -o landmarks
  crosscue study landmarks --drives 50 --workers 2
  crosscue study landmarks --settings my_car.toml -o mine
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
from crosscue.eval.commands.shared.terminal import progress_line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    add_study_arguments(parser, "study-landmarks")
    add_cluster_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run the study."""
    study = study_of(args, crosscue.LandmarkStudy)
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
