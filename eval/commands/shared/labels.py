"""Options of commands that compare a detector with labelled boxes."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from crosscue.datasets.truth.box_labels import meanings_of as meanings_of

FORMATS = ("coco", "yolo", "voc", "kitti")


def add_label_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--format``, ``--class-names``, ``--map``, ``--detector`` and ``--overlap``."""
    parser.add_argument(
        "--format", dest="kind", choices=FORMATS, help="format of the labels (default: detected)"
    )
    parser.add_argument(
        "--class-names",
        type=Path,
        default=(),
        metavar="FILE",
        help="class names, one per line: for YOLO in index order, for VOC and KITTI all classes",
    )
    parser.add_argument(
        "--map",
        dest="meanings",
        nargs="+",
        default=[],
        metavar="LABEL=NAME",
        help="class that a label of the file or detector counts as; LABEL= ignores it",
    )
    parser.add_argument(
        "--detector", metavar="NAME", help="name of the detector, if the run has several"
    )
    parser.add_argument(
        "--overlap",
        type=float,
        default=0.5,
        metavar="IOU",
        help="min IoU of a correct detection with a label (default: 0.5)",
    )


def label_options(args: argparse.Namespace) -> dict[str, Any]:
    """Return the values of these options as arguments of ``fit_detector`` and ``score_detector``.

    Raises:
        UsageError: ``--map`` is not ``LABEL=NAME``.
    """
    return {
        "detector": args.detector,
        "kind": args.kind,
        "class_names": args.class_names,
        "meanings": meanings_of(meanings=args.meanings),
        "overlap": args.overlap,
    }
