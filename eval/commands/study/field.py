"""The field protocol, simulated: successive goals in a 1 km2 town, through logs and the replay.

33 range runs without landmarks and 10 with at most one landmark at a time, 75 minutes each, compass
at 25 degrees. Every run is a log, a vehicle file and a truth file, replayed and scored by the code
that takes real ones; each can be examined with crosscue view. An interrupted study goes on with
the runs that are missing. A run takes seconds to a minute.

examples:
  crosscue study field -o field
  crosscue study field --range-runs 4 --landmark-runs 2 --minutes 20 -o field
  crosscue replay field/range_000/drive.mcap --vehicle field/range_000/vehicle.toml -o again
"""

from __future__ import annotations

import argparse

from crosscue.eval.commands.shared.options import print_json
from crosscue.eval.commands.shared.progress import Done, with_progress
from crosscue.eval.commands.shared.study import add_study_arguments, study_of, workers_of
from crosscue.replay.errors import UsageError


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
    from crosscue.eval.studies.town.field_study import NOTES, PAGE, drive_field, finish_field
    from crosscue.eval.studies.town.settings import FieldStudy

    study = study_of(args, FieldStudy)
    if not study.range_runs + study.landmark_runs:
        raise UsageError("study field: no runs; give --range-runs or --landmark-runs")
    done, runs = [0.0], []
    shares = drive_field(study, args.output, workers_of(args), overwrite=args.overwrite)

    def at() -> Done:
        return Done(100.0 * done[0], 100.0, "percent")

    for share, one in with_progress(shares, at, args, "driving and replaying"):
        done[0] = share
        runs.append(one)
    tables = finish_field(study, runs, args.output)
    if args.json:
        from dataclasses import asdict

        print_json([asdict(one) for one in runs])
    elif not args.quiet:
        print("\n\n".join(table.as_text() for table in tables))
        print("\n" + "\n".join(NOTES))
        print(f"\npage       {args.output / PAGE}")
    return 0 if all(one.is_whole for one in runs) else 3
