"""Replay a drive: run detectors on its camera, and estimate pose, cues, ranges and beliefs.

The run folder contains all tables and a manifest that accounts for every message. Detections are
cached by the content of each picture, so a second run is quick. --resume keeps the finished parts
of an interrupted run.

With many drives (a folder of drives, a quoted pattern, @list.txt, or --each), each drive gets its
own run folder below the output folder. They run in parallel with --workers, or on a Ray cluster
with --ray. A drive that fails does not stop the rest, and a second start processes only the missing
drives. --shard divides the drives among the tasks of a scheduler; crosscue status shows their
progress, and crosscue merge joins their results.

examples:
  crosscue replay drive.mcap --vehicle car.toml -o runs/drive
  crosscue replay 'drives/*/drive.mcap' --vehicle car.toml -o runs --workers 8
  crosscue replay drives -o runs --shard auto
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.detectors import (
    add_detector_arguments,
    cache_of,
    check_named,
    detectors_of,
)
from crosscue.eval.commands.shared.terminal import (
    DriveLine,
    DrivesLine,
    add_first_pose_arguments,
    add_part_arguments,
    is_shown,
    limits_of,
    part_of,
    print_result,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
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
        help="run folder; for many drives, the folder of their run folders",
    )
    parser.add_argument(
        "--vehicle",
        type=Path,
        metavar="V.toml",
        help="vehicle file (default: vehicle.toml next to a drive's logs)",
    )
    parser.add_argument("--each", action="store_true", help="treat each LOG as a separate drive")
    parser.add_argument(
        "--shard",
        metavar="I/N",
        help="process only part I of N of the drives, divided by a hash of each drive's identity; "
        "auto reads SLURM_ARRAY_TASK_ID and _COUNT, or RANK and WORLD_SIZE",
    )
    parser.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="number of drives in parallel (default: 1; with --ray, the cluster's cores)",
    )
    parser.add_argument(
        "--ray", metavar="ADDRESS", help="run on a Ray cluster: its address, auto, or local"
    )
    parser.add_argument(
        "--cores-per-drive", type=int, metavar="N", help="cores declared to Ray (default: 1)"
    )
    parser.add_argument(
        "--memory-per-drive",
        type=float,
        metavar="GIB",
        help="memory declared to Ray for each drive (default: 2)",
    )
    add_detector_arguments(parser)
    add_first_pose_arguments(parser, "gnss.use of the vehicle file, which is start unless set")
    parser.add_argument(
        "--landmarks",
        type=Path,
        metavar="DB",
        help="landmark database to match camera frames against",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing run")
    parser.add_argument(
        "--resume",
        action="store_true",
        help="continue an interrupted run and keep its finished parts",
    )
    parser.add_argument(
        "--retry-failed",
        action="store_true",
        help="process only the drives whose last attempt failed",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Replay; return 3 when something was dropped."""
    if args.draw < 0:
        raise crosscue.UsageError(f"--draw {args.draw}: expected 0 or more")
    check_named(args)
    found = crosscue.find_drives(*args.logs, each=args.each, shard=args.shard)
    if found.is_many:
        return _run_many(args, found)
    if args.workers is not None or args.ray is not None or args.retry_failed:
        raise crosscue.UsageError(
            "--workers, --ray, --retry-failed: expected many drives, found one; add --each to "
            "treat each log as a drive"
        )
    (drive,) = found.drives
    with DriveLine("replaying", is_shown=is_shown(args)) as line:
        run = crosscue.replay_drive(
            part_of(args, drive.logs),
            args.output,
            args.vehicle or drive.vehicle or crosscue.Vehicle(version=1),
            detectors_of(args),
            gnss=args.gnss,
            start=args.first_pose,
            landmarks=args.landmarks,
            cache=cache_of(args),
            draw=args.draw,
            overwrite=args.overwrite,
            resume=args.resume,
            on_frames=line.at_frame,
            on_time=line.at_time,
        )
    print_result(run.made, args)
    return run.made.exit_status


def _run_many(args: argparse.Namespace, found: crosscue.DriveList) -> int:
    if args.first_pose is not None:
        raise crosscue.UsageError(
            "--start: expected one drive, found many, each of which has its own start"
        )
    with DrivesLine("replaying", is_shown=is_shown(args)) as line:
        done = crosscue.replay_drives(
            found,
            args.output,
            args.vehicle,
            detectors_of(args),
            start=args.start,
            end=args.end,
            topics=args.topics,
            limits=limits_of(args),
            gnss=args.gnss,
            landmarks=args.landmarks,
            cache=cache_of(args),
            draw=args.draw,
            workers=args.workers,
            ray=args.ray,
            cores=args.cores_per_drive,
            memory_gib=args.memory_per_drive,
            overwrite=args.overwrite,
            resume=args.resume,
            retry_failed=args.retry_failed,
            on_progress=line,
        )
    print_result(done, args)
    return done.exit_status
