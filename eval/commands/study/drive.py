"""Simulate one drive of a study: a picture, a log for crosscue replay, a run, a Rerun recording.

A study's drives.parquet contains the seed of each drive. The same seed and settings reproduce the
drive.

examples:
  crosscue study drive --seed 7 -o drive
  crosscue study drive --seed 7 --strategy "landmark to landmark" --landmark-density 1 -o drive
  crosscue view drive/run --truth drive/truth.json
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import print_result

STRATEGIES = ("straight to goal", "landmark to landmark", "hybrid")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path("study-drive"),
        metavar="DIR",
        help="folder for the log, truth, picture and run (default: study-drive)",
    )
    parser.add_argument("--seed", type=int, default=7, metavar="N", help="random seed (default: 7)")
    parser.add_argument(
        "--compass",
        type=float,
        default=30.0,
        metavar="DEG",
        help="2-sigma error of the compass in degrees; 0 for no compass (default: 30)",
    )
    parser.add_argument(
        "--strategy",
        choices=STRATEGIES,
        default=STRATEGIES[0],
        help="navigation strategy (default: straight to goal)",
    )
    parser.add_argument(
        "--landmark-density",
        type=float,
        default=0.0,
        metavar="N",
        help="landmarks per square kilometre (default: 0)",
    )
    parser.add_argument(
        "--detection-rate",
        type=float,
        default=0.6,
        metavar="P",
        help="probability that a landmark in view is recognised (default: 0.6)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing drive")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Simulate, draw, write, replay and score the drive."""
    found = crosscue.run_study_drive(
        args.output,
        args.seed,
        compass_2sigma_deg=args.compass or None,
        strategy=args.strategy,
        landmarks_per_km2=args.landmark_density,
        detection_rate=args.detection_rate,
        overwrite=args.overwrite,
    )
    print_result(found, args)
    return 0 if found.is_whole else 3
