"""Write a first vehicle file from the contents of a log.

example:
  crosscue vehicle init drive.mcap --dbc car.dbc -o car.toml
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

import crosscue
from crosscue.eval.commands.shared.terminal import (
    add_file_output,
    add_limit_arguments,
    limits_of,
    print_json,
)

MOUNTING: Final = {
    "x-m": "distance of the camera ahead of the rear axle",
    "y-m": "distance to the left of the car's centre line",
    "height-m": "height above the road",
    "pitch-deg": "angle of its axis below the horizon (default: estimated from pictures of a "
    "straight road)",
    "yaw-deg": "angle of its axis to the left (default: estimated, too)",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="recordings of one drive")
    parser.add_argument(
        "--dbc",
        nargs="+",
        type=Path,
        default=[],
        metavar="FILE",
        help="DBC, KCD, ARXML or SYM files of the CAN buses",
    )
    for name, what in MOUNTING.items():
        parser.add_argument(
            f"--camera-{name}", type=float, metavar=name.rpartition("-")[2].upper(), help=what
        )
    add_limit_arguments(parser)
    add_file_output(parser, "V.toml", "vehicle file to write (default: print it)")


def run(args: argparse.Namespace) -> int:
    """Draft the file, check that it can be read back, and write or print it."""
    found = crosscue.draft_vehicle(
        crosscue.UnopenedLog((*args.logs,), limits=limits_of(args)),
        args.dbc,
        args.output,
        overwrite=args.overwrite,
        camera_x_m=args.camera_x_m,
        camera_y_m=args.camera_y_m,
        camera_height_m=args.camera_height_m,
        camera_pitch_deg=args.camera_pitch_deg,
        camera_yaw_deg=args.camera_yaw_deg,
    )
    if args.json:
        print_json(found.as_dict())
    elif found.path is None:
        print(found)
    elif not args.quiet:
        print(found.path)
    return 0
