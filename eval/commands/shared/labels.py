"""Options of commands that compare a detector with labelled boxes."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import crosscue

FORMATS = ("coco", "yolo", "voc", "kitti")


def add_label_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--format``, ``--class-names``, ``--map``, ``--detector`` and ``--overlap``."""
    parser.add_argument(
        "--format", choices=FORMATS, help="format of the labels (default: detected)"
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
        "kind": args.format,
        "class_names": args.class_names,
        "meanings": meanings_of(args.map),
        "overlap": args.overlap,
    }


def meanings_of(texts: Sequence[str]) -> dict[str, str]:
    """Return the class of each label in ``--map LABEL=NAME...``.

    Raises:
        UsageError: A text is not ``LABEL=NAME``.
    """
    found = {}
    for text in texts:
        name, equals, means = text.rpartition("=")
        if not equals or not name:
            raise crosscue.UsageError(f"--map {text}: expected LABEL=NAME")
        found[name] = means
    return found
