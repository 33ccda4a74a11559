"""Add landmarks to a database, from a log with poses or from pictures with coordinates.

Either all pictures of a call are added, or none. Coordinates are in metres in the map frame: x
east, y north. The CSV file has the columns image,x_m,y_m,sd_m (or var_x_m2,cov_xy_m2,var_y_m2
instead of sd_m) and, optionally, heading_rad.

example:
  crosscue landmarks add town.sqlite drive.mcap --poses runs/drive --every 10
  crosscue landmarks add town.sqlite --images photos --coordinates photos.csv
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import (
    add_part_arguments,
    metres,
    part_of,
    print_result,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
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
    """Add landmarks; return 3 when a log is damaged."""
    given = (bool(args.logs), bool(args.poses), bool(args.images), bool(args.coordinates))
    if given == (True, True, False, False):
        found = crosscue.add_landmarks(
            args.database,
            part_of(args, args.logs),
            args.poses,
            args.vehicle,
            every_m=args.every,
            sd_m=args.sd,
            source=args.source,
            matcher=args.matcher,
        )
    elif given == (False, False, True, True):
        found = crosscue.add_landmark_images(
            args.database,
            args.images,
            args.coordinates,
            args.vehicle,
            source=args.source,
            matcher=args.matcher,
        )
    else:
        raise crosscue.UsageError(
            "landmarks add: expected LOG... with --poses, or --images with --coordinates"
        )
    print_result(found, args)
    return 0 if found.is_whole else 3
