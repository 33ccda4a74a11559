"""Fit beliefs to random simulated layouts, and test them on other layouts.

There are thirteen kinds of layouts, five of them without an intersection. Every drive is rendered
and processed by the embedded networks, and each belief is scored on layouts that it was not fitted
to. With --perception faults, no network runs: the renderer's masks are used, with simulated faults.
Writes study.html and study.json. A second start processes only the missing drives.

example:
  crosscue study layouts -o layouts --workers 2
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        type=Path,
        metavar="DIR",
        help="folder for drives, runs, tables and page",
    )
    parser.add_argument(
        "--perception",
        choices=("pixels", "faults"),
        default="pixels",
        help="detections from networks on pixels, or from simulated faults (default: pixels)",
    )
    parser.add_argument(
        "--blocks", type=int, default=8, metavar="N", help="blocks of thirteen layouts (default: 8)"
    )
    parser.add_argument(
        "--runs", type=int, default=2, metavar="N", help="drives per layout (default: 2)"
    )
    parser.add_argument(
        "--folds", type=int, default=4, metavar="N", help="folds, by layout (default: 4)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument(
        "--width",
        type=int,
        default=960,
        metavar="PX",
        help="image width in pixels; height is 9/16 (default: 960)",
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="number of drives in parallel (default: 1)",
    )
    parser.add_argument(
        "--no-ablation", action="store_true", help="skip the ablation of cues and rules"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Simulate, replay, fit and test; return 3 when a drive failed."""
    study = crosscue.LayoutStudy(
        perception=args.perception,
        blocks=args.blocks,
        runs=args.runs,
        folds=args.folds,
        seed=args.seed,
        width_px=args.width,
    )
    found = crosscue.run_layout_study(
        study,
        args.output,
        args.workers,
        ablation=not args.no_ablation,
    )
    print_result(found, args)
    return found.exit_status
