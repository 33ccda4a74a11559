"""Score a detector's boxes in a run against labelled boxes of its images.

LABELS is a COCO .json, or a folder of YOLO .txt, Pascal VOC .xml or KITTI .txt files. Images are
matched to frames by file name if the log is a folder of images, else by log time (t_ns of a COCO
file, or a file name that is a time in nanoseconds), else by the frame number, from 0, at the end of
the file name. Frames without labels are not judged.

Prints AP50 and AP (COCO), precision and recall above the detector's threshold, by class, size and
range, and the calibration of scores. The page in RUN/score shows the worst images.

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
    """Add the options to the parser."""
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
        help="count images within this many seconds as one (default: 1)",
    )
    parser.add_argument(
        "--draw", type=int, default=8, metavar="N", help="draw the N worst images (default: 8)"
    )
    add_logs_arguments(parser)
    parser.add_argument(
        "--without-figures",
        dest="has_figures",
        action="store_false",
        help="omit the reliability diagram, which needs matplotlib",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Score and report; return 3 when the run has drops."""
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
