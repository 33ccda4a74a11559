"""Replay a drive: run detectors over its camera, estimate pose, cues, ranges and beliefs.

The run folder then holds every table, and a manifest that accounts for every message. What was
found in a picture is kept by content, so a second run is quick; --resume keeps what an interrupted
run had finished.

Many drives (a folder of drives, a quoted pattern, @list.txt, or --each) get a run folder each below
the one given, side by side with --workers or on a Ray cluster with --ray. One that fails does not
stop the rest, and a second start does only what is missing.

examples:
  crosscue replay drive.mcap --vehicle car.toml -o runs/drive
  crosscue replay 'drives/*/drive.mcap' --vehicle car.toml -o runs --workers 8
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from crosscue.eval.batch.drive_list import DriveInput, DriveList, drives_of
from crosscue.eval.batch.engine import engine_of
from crosscue.eval.batch.jobs import (
    Done,
    Job,
    exit_status_of,
    fingerprint_of,
    run_many,
)
from crosscue.eval.batch.merge import FOLDER, gathered, merge_runs
from crosscue.eval.commands.shared.detectors import add_detector_arguments, cache_of, detectors_of
from crosscue.eval.commands.shared.drive_part import open_part
from crosscue.eval.commands.shared.options import (
    add_part_arguments,
    print_json,
    print_result,
)
from crosscue.eval.commands.shared.progress import DriveLine, DrivesLine, is_shown
from crosscue.eval.interface.runs import replay_drive
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.runs.folder import create
from crosscue.eval.runs.input import files_named_in
from crosscue.replay.base import CrosscueError, UsageError, versions, visible
from crosscue.replay.vehicle.vehicle import Vehicle, load


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument(
        "logs",
        nargs="+",
        metavar="LOG",
        help="recordings of one drive, or drives; paths or URLs",
    )
    add_part_arguments(parser)
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        type=Path,
        metavar="RUN",
        help="run folder; for many drives, the folder that gets one run folder per drive",
    )
    parser.add_argument(
        "--vehicle",
        type=Path,
        metavar="V.toml",
        help="vehicle file (default: vehicle.toml beside a drive's logs)",
    )
    parser.add_argument("--each", action="store_true", help="treat each LOG as a separate drive")
    parser.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="number of drives in parallel (default: 1; with --ray, the cores of the cluster)",
    )
    parser.add_argument(
        "--ray", metavar="ADDRESS", help="run on a Ray cluster: its address, auto, or local"
    )
    add_detector_arguments(parser)
    parser.add_argument(
        "--landmarks",
        type=Path,
        metavar="DB",
        help="landmark database to match camera frames against",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing run")
    parser.add_argument(
        "--resume", action="store_true", help="continue an interrupted run and keep finished parts"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Replay; 3 when something was dropped."""
    if args.draw < 0:
        raise UsageError(f"--draw {args.draw}: expected 0 or more")
    drives = drives_of(args.logs, each=args.each)
    if drives.is_many:
        return _run_many(args, drives)
    if args.workers is not None or args.ray is not None:
        raise UsageError("--workers, --ray: for many drives; this is one (--each makes it many)")
    with DriveLine("replaying", is_shown=is_shown(args)) as line:
        outcome = _replay(drives.drives[0], args.output, args, line)
    print_result(outcome, args)
    return outcome.exit_status


def _vehicle(path: Path | None, own: Path | None) -> Vehicle:
    found = path or own
    return Vehicle(version=1) if found is None else load(found)


def _replay(
    drive: DriveInput | Job, output: Path, args: argparse.Namespace, line: DriveLine
) -> Outcome:
    with open_part(args, drive.logs) as log:
        run = replay_drive(
            log,
            output,
            _vehicle(args.vehicle, drive.vehicle),
            detectors_of(args),
            landmarks=args.landmarks,
            cache=cache_of(args),
            draw=args.draw,
            overwrite=args.overwrite,
            resume=args.resume,
            on_frames=line.at_frame,
            on_time=line.at_time,
        )
    assert isinstance(run.outcome, Outcome)
    return run.outcome


@dataclass(frozen=True, slots=True)
class _Work:
    """One of many drives, here or in another process."""

    args: argparse.Namespace

    def __call__(self, job: Job) -> Outcome:
        # Whether a folder may be replaced was decided before the drive was handed out.
        args = argparse.Namespace(**{**vars(self.args), "overwrite": True})
        return _replay(job, job.run, args, DriveLine("", is_shown=False))


def _run_many(args: argparse.Namespace, drives: DriveList) -> int:
    engine = engine_of(args.workers, args.ray)
    jobs = [
        Job(
            drive.name,
            drive.logs,
            args.output / drive.name,
            _fingerprint(args, drive),
            drive.vehicle,
            drive.truth,
        )
        for drive in drives.drives
    ]
    with DrivesLine("replaying", is_shown=is_shown(args)) as line:
        done = run_many(jobs, _Work(args), engine, overwrite=args.overwrite, on_progress=line)
    line.end()
    status = exit_status_of(done)
    where, why = str(args.output / FOLDER), None
    try:
        _merge(done, args.output)
    except CrosscueError as error:
        # The drives are done, and that must be reported, whatever became of their common table.
        status, why = status or 3, str(error)
    if args.json:
        reported = [_drive_as_json(one) for one in done]
        print_json({"drives": reported, "merged": where, "not_merged": why})
    elif not args.quiet:
        tables = where if why is None else f"not merged: {why}"
        print("\n".join([*_drive_lines(done), f"tables   {visible(tables)}"]))
    return status


def _merge(done: Sequence[Done[Outcome]], output: Path) -> None:
    """One table of all runs in the folder, those of earlier batches too."""
    runs, failures = gathered([output])
    ended = {one.job.name: one.error for one in done}
    # A drive that failed now has no run, though an earlier start may have left one that was cut.
    runs = {name: run for name, run in runs.items() if ended.get(name) is None}
    failed = {name: why for name, why in ended.items() if why is not None}
    merge_runs(runs, create(output / FOLDER, overwrite=True), {**failures, **failed})


def _fingerprint(args: argparse.Namespace, drive: DriveInput) -> str:
    """Of everything that decides a drive's run besides its logs."""
    flags = {
        name: None if getattr(args, name) is None else str(getattr(args, name))
        for name in ("detectors", "draw", "start", "end", "topics")
    }
    flags["landmarks"] = None if args.landmarks is None else str(args.landmarks.resolve())
    try:
        settings: object = _vehicle(args.vehicle, drive.vehicle).model_dump(mode="json")
    except CrosscueError as error:
        # This drive's own attempt reports it; the others must not suffer.
        settings = str(error)
    return fingerprint_of(settings, flags, versions(), files_named_in([settings, flags]))


def _drive_lines(done: Sequence[Done[Outcome]]) -> list[str]:
    lines = []
    for one in done:
        if one.error is not None:
            lines.append(f"failed   {one.job.name}: {one.error}")
        elif one.is_earlier:
            lines.append(f"earlier  {one.job.name}: done before, kept")
        else:
            lost = "" if not one.exit_status else ", with losses"
            lines.append(f"done     {one.job.name}: {one.seconds:.1f} s{lost}")
    failed = sum(one.error is not None for one in done)
    lines.append(f"drives   {len(done) - failed} of {len(done)}, {failed} failed")
    return [visible(line) for line in lines]


def _drive_as_json(one: Done[Outcome]) -> dict[str, object]:
    return {
        "name": one.job.name,
        "run": str(one.job.run),
        "exit_status": one.exit_status,
        "error": one.error,
        "earlier": one.is_earlier,
        "attempts": one.attempts,
        "seconds": one.seconds,
        "result": None if one.result is None else one.result.as_dict(),
    }
