"""Export the pictures of failures for labelling, with the detections in them as pre-labels.

FAILURES is a table from crosscue failures -o. Each frame is exported once, with its picture as
recorded. File names contain drive and time, which crosscue truth import --export uses to find the
frames again. Pre-labels are detections: correct them before you use them as labels.

examples:
  crosscue failures runs --top 10 -o worst.parquet
  crosscue export worst.parquet --to cvat -o labelling
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import (
    add_logs_argument,
    limits_of,
    print_result,
    progress_line,
)

FORMATS = ("coco", "cvat", "yolo", "fiftyone", "labelstudio")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("failures", type=Path, metavar="FAILURES", help="table of failures")
    parser.add_argument("--to", choices=FORMATS, default="coco", help="format (default: coco)")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the export"
    )
    parser.add_argument(
        "--classes",
        nargs="+",
        default=[],
        metavar="NAME",
        help="labels to choose from (default: the labels that the runs' cues use)",
    )
    add_logs_argument(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier export")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Export the pictures; return 3 when a run could not be read."""
    with progress_line(args, "exporting") as line:
        found = crosscue.export(
            args.failures,
            args.output,
            args.to,
            classes=args.classes,
            logs=args.logs,
            limits=limits_of(args),
            overwrite=args.overwrite,
            on_runs=line.counting("runs"),
        )
    print_result(found, args)
    return 3 if found.failed else 0
