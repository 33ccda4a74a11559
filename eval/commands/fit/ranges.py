"""Fit a curve from an object's height in pixels to its range, and report residuals by distance.

Pairs of height and range are read from a TABLE (CSV or Parquet with the columns height_px and
range_m, from the rear axle), from the annotated objects of drives (--truth), or from the detections
of runs (--runs with --truth). All families of curves are fitted. The one with the smallest residual
is printed as a section for the vehicle file. --test measures that curve on other drives.

examples:
  crosscue fit ranges stop_signs.csv --cue stop_sign
  crosscue fit ranges --cue traffic_light --truth drives/L* --test drives/A-01 --figure light.png
  crosscue fit ranges --cue stop_sign --runs runs/A-01 --truth drives/A-01
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.detectors.ranging.height_to_range import FAMILIES
from crosscue.eval.commands.shared.terminal import print_result
from crosscue.eval.interface.fits.ranges import PUBLISHED_SD_M


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument(
        "table",
        nargs="?",
        type=Path,
        metavar="TABLE",
        help="CSV or Parquet file with the columns height_px and range_m",
    )
    parser.add_argument(
        "--cue",
        required=True,
        choices=tuple(PUBLISHED_SD_M),
        help="cue whose objects were measured",
    )
    parser.add_argument(
        "--truth",
        nargs="+",
        type=Path,
        metavar="TRUTH",
        default=[],
        help="drives with annotated objects and ranges",
    )
    parser.add_argument(
        "--runs",
        nargs="+",
        type=Path,
        metavar="RUN",
        default=[],
        help="run folders with detections to measure heights in, one per --truth",
    )
    parser.add_argument(
        "--min-score",
        type=float,
        default=0.9,
        metavar="P",
        help="min score of a detection (default: 0.9)",
    )
    parser.add_argument(
        "--test",
        nargs="+",
        type=Path,
        metavar="TRUTH",
        default=[],
        help="other drives to measure the curve on",
    )
    parser.add_argument("--family", choices=FAMILIES, help="fit only this family of curves")
    parser.add_argument(
        "--bin-m",
        type=float,
        default=10.0,
        metavar="M",
        help="width of the distance bins (default: 10)",
    )
    parser.add_argument(
        "--figure",
        type=Path,
        metavar="PNG",
        help="figure to write, with pairs, curves and residuals",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing figure")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Fit and report."""
    found = crosscue.fit_ranges(
        args.cue,
        args.table,
        args.truth,
        args.runs,
        test=args.test,
        min_score=args.min_score,
        family=args.family,
        bin_m=args.bin_m,
        figure=args.figure,
        overwrite=args.overwrite,
    )
    print_result(found, args)
    return 0
