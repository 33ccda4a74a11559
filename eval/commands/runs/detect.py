"""Run detectors on a drive's camera and write detections, road fractions and cues to a run folder.

A detector is a built-in name, a section [detectors.NAME] of the vehicle file, a module:factory, or
a model card (.toml). Results are cached by the content of each picture, so a second run is quick.

example:
  crosscue detect drive.mcap --vehicle car.toml --detectors yolox.toml,signs -o runs/drive
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.detectors import add_detector_arguments, cache_of, detectors_of
from crosscue.eval.commands.shared.terminal import (
    DriveLine,
    add_log_arguments,
    is_shown,
    part_of,
    print_result,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    add_log_arguments(parser)
    parser.add_argument(
        "-o", "--output", required=True, type=Path, metavar="RUN", help="run folder"
    )
    parser.add_argument("--vehicle", type=Path, metavar="V.toml", help="vehicle file")
    add_detector_arguments(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace an existing run")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Detect; return 3 when something was dropped."""
    if args.draw < 0:
        raise crosscue.UsageError(f"--draw {args.draw}: expected 0 or more")
    with DriveLine("detecting", is_shown=is_shown(args)) as line:
        run = crosscue.detect_drive(
            part_of(args, args.logs),
            args.output,
            args.vehicle or crosscue.Vehicle(version=1),
            detectors_of(args),
            cache=cache_of(args),
            draw=args.draw,
            overwrite=args.overwrite,
            on_frames=line.at_frame,
        )
    print_result(run.made, args)
    return run.made.exit_status
