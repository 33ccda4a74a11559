"""Score a detector's boxes in a run against labelled boxes of its images.

LABELS is a COCO .json, or a folder of YOLO .txt, Pascal VOC .xml or KITTI .txt files. Images find
their frames by file name where the log is a folder of images, else by log time (t_ns of a COCO
file, or a name that is a time in nanoseconds), else by the number that the name ends in, the first
frame being 0. Frames without labels are not judged.

Prints AP50, AP (COCO), precision and recall above the detector's threshold, by class, size and
range, and the calibration of scores; the page in RUN/score shows the worst images.

examples:
  crosscue score detector runs/A-01 --labels labels.json
  crosscue score detector runs/A-01 --labels labels.json --map car=vehicle truck=vehicle bus=vehicle
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.labels import add_label_arguments, label_options
from crosscue.eval.commands.shared.terminal import add_logs_arguments, limits_of, print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder with detections")
    parser.add_argument(
        "--labels", type=Path, required=True, metavar="LABELS", help="labelled boxes of its images"
    )
    add_label_arguments(parser)
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="DIR",
        help="folder for the page and its numbers (default: RUN/score)",
    )
    parser.add_argument(
        "--block-s",
        type=float,
        default=1.0,
        metavar="S",
        help="count images within so many seconds as one (default: 1)",
    )
    parser.add_argument(
        "--draw", type=int, default=8, metavar="N", help="draw the N worst images (default: 8)"
    )
    add_logs_arguments(parser)
    parser.add_argument(
        "--without-figures",
        dest="has_figures",
        action="store_false",
        help="leave out the reliability diagram, for which matplotlib is imported",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Score and report; 3 when the run had dropped something."""
    found = crosscue.score_detector(
        args.run,
        args.labels,
        args.output,
        **label_options(args),
        block_s=args.block_s,
        draw=args.draw,
        logs=args.logs,
        without_images=args.without_images,
        has_figures=args.has_figures,
        limits=limits_of(args),
    )
    print_result(found, args)
    return 0 if found.is_whole else 3
