"""Add landmarks to a database: from a log with poses, or from pictures with coordinates.

All pictures of one call are added, or none. Coordinates are metres in the map frame: x east, y
north. The CSV file has the columns image,x_m,y_m,sd_m (or var_x_m2,cov_xy_m2,var_y_m2 for sd_m)
and may have heading_rad.

example:
  crosscue landmarks add town.sqlite drive.mcap --poses runs/drive --every 10
  crosscue landmarks add town.sqlite --images photos --coordinates photos.csv
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from crosscue.eval.commands.shared.drive_part import selection_of
from crosscue.eval.commands.shared.options import add_part_arguments, limits_of, metres, print_json
from crosscue.eval.fit.landmark_database import (
    AddCounts,
    add_from_images,
    add_from_log,
    camera_frames,
    read_poses,
)
from crosscue.eval.pipeline.landmarks import matcher_for
from crosscue.localization.landmarks.database import LandmarkWriter
from crosscue.localization.landmarks.features import Matcher
from crosscue.replay.base import EmptyResultError, Ledger, UsageError, visible
from crosscue.replay.logs.opening import open_logs
from crosscue.replay.losses import warn_of
from crosscue.replay.vehicle.vehicle import Vehicle, load


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument(
        "database", type=Path, metavar="DB", help="landmark database; created if missing"
    )
    parser.add_argument("logs", nargs="*", type=Path, metavar="LOG", help="recordings of one drive")
    parser.add_argument(
        "--poses",
        type=Path,
        metavar="RUN|T.json",
        help="poses of the vehicle: a run or a truth file",
    )
    parser.add_argument("--images", type=Path, metavar="DIR", help="folder of images")
    parser.add_argument(
        "--coordinates", type=Path, metavar="FILE.csv", help="position of each image"
    )
    parser.add_argument(
        "--every",
        type=metres,
        default=10.0,
        metavar="M",
        help="distance between landmarks from a log, in metres (default: 10)",
    )
    parser.add_argument(
        "--sd",
        type=metres,
        default=3.0,
        metavar="M",
        help="standard deviation of the vehicle's position at a match, in metres, added to the "
        "error of the poses (default: 3)",
    )
    parser.add_argument(
        "--source", metavar="NAME", help="name of the source (default: the log's name)"
    )
    parser.add_argument(
        "--vehicle", type=Path, metavar="V.toml", help="vehicle file: camera and matcher"
    )
    parser.add_argument("--matcher", metavar="NAME", help="orb, or your own module:factory")
    add_part_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Add; 3 when a log was damaged."""
    _check(args)
    vehicle = load(args.vehicle) if args.vehicle else Vehicle(version=1)
    matcher = matcher_for(vehicle, args.matcher)
    is_whole = True
    if args.images:
        source = visible(args.source or args.images.resolve().name)
        with LandmarkWriter(args.database, matcher.kind) as writer:
            counts = add_from_images(writer, matcher, args.images, args.coordinates, source)
            _refuse_none(args.database, counts)
    else:
        counts, is_whole = _add_logs(args, vehicle, matcher)
    if args.json:
        print_json({"database": str(args.database), **asdict(counts)})
    elif not args.quiet:
        print(_report_text(args.database, counts))
    return 0 if is_whole else 3


def _check(args: argparse.Namespace) -> None:
    given = (bool(args.logs), bool(args.poses), bool(args.images), bool(args.coordinates))
    if given not in ((True, True, False, False), (False, False, True, True)):
        raise UsageError("landmarks add: give LOG... with --poses, or --images with --coordinates")


def _add_logs(
    args: argparse.Namespace, vehicle: Vehicle, matcher: Matcher
) -> tuple[AddCounts, bool]:
    poses = read_poses(args.poses, vehicle)
    with open_logs(args.logs, limits_of(args)) as logs:
        ledgers = [Ledger(str(log.path)) for log in logs]
        frames = camera_frames(logs, vehicle, selection_of(args, logs), ledgers)
        source = visible(args.source or args.logs[0].resolve().stem)
        with LandmarkWriter(args.database, matcher.kind) as writer:
            counts = add_from_log(
                writer, matcher, frames, poses, args.every, args.sd, source, ledgers
            )
            for ledger in ledgers:
                warn_of(ledger)
            _refuse_none(args.database, counts)
    return counts, all(ledger.is_whole for ledger in ledgers)


def _refuse_none(database: Path, counts: AddCounts) -> None:
    """Leave the database as it was; within the writer's block, which then takes all back."""
    if not counts.added:
        raise EmptyResultError(f"{_report_text(database, counts)}; give other pictures or poses")


def _report_text(database: Path, counts: AddCounts) -> str:
    left_out = [
        f"{count} {why}"
        for count, why in (
            (counts.too_near, "too near the last"),
            (counts.without_pose, "without a pose at their time"),
            (counts.undecodable, "do not decode"),
            (counts.blank, "show too little"),
        )
        if count
    ]
    rest = f"; not: {', '.join(left_out)}" if left_out else ""
    return f"{database}: {counts.added} landmarks added of {counts.pictures} pictures{rest}"
