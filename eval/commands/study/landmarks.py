"""Who reaches the goal? 3 strategies by 5 landmark densities by 5 detection rates by 700 drives.

Success against the distance to the goal, range at 80 % success, and how much farther the
strategies drive, beside the published numbers. An interrupted study goes on where it stopped; the
result is the same on any number of workers.

examples:
  crosscue study landmarks -o landmarks
  crosscue study landmarks --drives 50 --workers 2
  crosscue study landmarks --settings my_car.toml -o mine
"""

from __future__ import annotations

import argparse

from crosscue.eval.commands.shared.study import (
    add_cluster_arguments,
    add_study_arguments,
    run_study,
    study_of,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    add_study_arguments(parser, "study-landmarks")
    add_cluster_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Drive."""
    from crosscue.eval.studies.town.settings import LandmarkStudy
    from crosscue.eval.studies.town.whole import finish_landmarks

    return run_study(args, study_of(args, LandmarkStudy), finish_landmarks, "driving")
