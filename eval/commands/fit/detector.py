"""Fit thresholds and calibrations of a detector to labelled boxes, and write them into its card.

Each class gets the lowest threshold that reaches the required precision. Precision is judged by
Clopper and Pearson's one-sided 95 % bound, corrected for the choice among eight thresholds. Each
class also gets a calibration, so that a score is the probability that a detection is correct. The
last half of each run's images is held out to test the result, unless --test names other runs. A
class with too few labelled boxes is reported and keeps its values.

The bounds assume that detections are independent, but those of neighbouring images are not.
Therefore, use several drives.

examples:
  crosscue fit detector runs/A-01 --labels labels.json -o my.toml
  crosscue fit detector runs/* --labels labels/*.json --precision 0.98 -o my.toml
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.labels import add_label_arguments, label_options
from crosscue.eval.commands.shared.terminal import add_logs_argument, limits_of, print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="runs with detections")
    parser.add_argument(
        "--labels",
        type=Path,
        nargs="+",
        required=True,
        metavar="LABELS",
        help="labelled boxes of each run's images, in the same order",
    )
    add_label_arguments(parser)
    parser.add_argument(
        "--precision",
        type=float,
        default=0.95,
        metavar="P",
        help="required precision (default: 0.95)",
    )
    parser.add_argument(
        "--calibration",
        choices=("platt", "isotonic", "none"),
        default="platt",
        help="calibration from scores to probabilities (default: platt)",
    )
    parser.add_argument(
        "--hold-out",
        type=float,
        default=0.5,
        metavar="FRACTION",
        help="last fraction of each run's images, held out to test the result (default: 0.5)",
    )
    parser.add_argument(
        "--test",
        type=Path,
        nargs="+",
        default=[],
        metavar="RUN",
        help="other runs to test the result on",
    )
    parser.add_argument(
        "--test-labels",
        type=Path,
        nargs="+",
        default=[],
        metavar="LABELS",
        help="labelled boxes of each run of --test, in the same order",
    )
    parser.add_argument(
        "--card", type=Path, metavar="CARD.toml", help="the detector's card (default: the run's)"
    )
    parser.add_argument(
        "--date", default="", metavar="DATE", help="date of the fit, to record in the card"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="CARD.toml",
        help="card to write; may be the same file (default: write none)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace another existing card")
    add_logs_argument(parser)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Fit and report; return 1 when no class gets a threshold, 3 when runs have drops."""
    found = crosscue.fit_detector(
        args.runs,
        args.labels,
        args.output,
        precision=args.precision,
        calibration=args.calibration,
        test=args.test,
        test_labels=args.test_labels,
        hold_out=args.hold_out,
        card=args.card,
        **label_options(args),
        date=args.date,
        overwrite=args.overwrite,
        logs=args.logs,
        limits=limits_of(args),
    )
    print_result(found, args)
    if not found.has_threshold:
        return 1
    return 0 if found.is_whole else 3
