"""Choose the sign detector's threshold for a required precision, and measure it on other images.

LABELS is a CSV file with the columns picture,label,x0,y0,x1,y1 and one row per sign (an empty label
for a picture without signs), a COCO file as crosscue train frames writes it, or the folder of a
drive with annotated objects. The threshold is chosen on every second picture and measured on the
others, unless --test names other files or drives. --threshold measures the given threshold instead.

examples:
  crosscue fit signs labels.csv --label "do not enter" --kinds "no entry" --precision 0.95
  crosscue fit signs fit/coco.json --test drives/* --label "one way left" "one way right"
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.detectors.signs.templates import AMERICAN, KINDS
from crosscue.eval.commands.shared.terminal import (
    Done,
    add_limit_arguments,
    limits_of,
    print_result,
    with_progress,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument(
        "labels",
        type=Path,
        nargs="+",
        metavar="LABELS",
        help="CSV or COCO file of boxes, or a drive's folder",
    )
    parser.add_argument(
        "--test",
        type=Path,
        nargs="+",
        metavar="LABELS",
        default=[],
        help="other frames to measure on",
    )
    parser.add_argument(
        "--test-every", type=int, default=1, metavar="N", help="measure on every Nth image"
    )
    parser.add_argument(
        "--label", required=True, nargs="+", metavar="LABEL", help="labels that share the threshold"
    )
    parser.add_argument(
        "--kinds",
        nargs="+",
        default=list(AMERICAN),
        choices=KINDS,
        metavar="KIND",
        help=f"templates to search for, from: {', '.join(KINDS)}",
    )
    parser.add_argument(
        "--crop-top",
        type=float,
        default=0.0,
        metavar="FRACTION",
        help="top fraction of the image to skip",
    )
    parser.add_argument(
        "--crop-bottom",
        type=float,
        default=0.25,
        metavar="FRACTION",
        help="bottom fraction of the image to skip",
    )
    parser.add_argument(
        "--enlarge",
        type=float,
        default=2.5,
        metavar="X",
        help="magnification of the first pyramid level (default: 2.5)",
    )
    parser.add_argument(
        "--levels",
        type=int,
        default=14,
        metavar="N",
        help="pyramid levels, each smaller by 1.25 (default: 14)",
    )
    parser.add_argument(
        "--points", type=int, default=4000, metavar="N", help="keypoints per level (default: 4000)"
    )
    parser.add_argument(
        "--precision",
        type=float,
        default=0.95,
        metavar="P",
        help="required precision (default: 0.95)",
    )
    parser.add_argument(
        "--threshold",
        type=float,
        metavar="P",
        help="measure this threshold instead of choosing one",
    )
    parser.add_argument(
        "--overlap",
        type=float,
        default=0.4,
        metavar="IOU",
        help="min IoU with the true box of a true positive (default: 0.4)",
    )
    parser.add_argument(
        "--min-height",
        type=float,
        default=0.0,
        metavar="PX",
        help="ignore true signs lower than this, in pixels",
    )
    add_limit_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Choose and report; return 1 when no threshold reaches the required precision."""
    fitted = crosscue.fit_signs(
        args.labels,
        args.label,
        test=args.test,
        test_every=args.test_every,
        kinds=args.kinds,
        precision=args.precision,
        threshold=args.threshold,
        overlap=args.overlap,
        min_height_px=args.min_height,
        crop_top=args.crop_top,
        crop_bottom=args.crop_bottom,
        enlarge=args.enlarge,
        levels=args.levels,
        points=args.points,
        limits=limits_of(args),
        progress=lambda parts, done: with_progress(
            parts, lambda: Done(*done(), "sets"), args, "looking"
        ),
    )
    print_result(fitted, args)
    return 0 if fitted.threshold is not None else 1
