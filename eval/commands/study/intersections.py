"""Repeat the published experiment on simulated drives, and compare with its results.

Simulates each drive, replays it from its pictures with the embedded detectors, scores it, and
writes study.html, study.json and score/metrics.json. Distances, cues and beliefs are shown next to
the published ones. A second start processes only the missing drives.

example:
  crosscue study intersections -o study --runs 10 --workers 2
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.datasets.scenes.layout import SCORED
from crosscue.detectors.registry import EMBEDDED
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
        "--layouts",
        default=",".join(SCORED),
        metavar="NAMES",
        help="comma-separated layouts, A to H (default: all)",
    )
    parser.add_argument(
        "--runs", type=int, default=10, metavar="N", help="runs per layout (default: 10)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument(
        "--width",
        type=int,
        default=1280,
        metavar="PX",
        help="image width in pixels; height is 9/16 (default: 1280)",
    )
    parser.add_argument(
        "--vehicle", type=Path, metavar="V.toml", help="vehicle file (default: that of each drive)"
    )
    parser.add_argument(
        "--detectors",
        default=EMBEDDED,
        metavar="NAMES",
        help=f"comma-separated names (default: {EMBEDDED})",
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="number of drives in parallel (default: 1)",
    )
    parser.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="run on a Ray cluster that shares DIR: its address, auto, or local",
    )
    parser.add_argument(
        "--no-attribution", action="store_true", help="skip the ablation of each cue"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Simulate, replay and score; return 3 when a drive failed."""
    study = crosscue.IntersectionStudy(
        layouts=tuple(name.strip() for name in args.layouts.split(",") if name.strip()),
        runs=args.runs,
        seed=args.seed,
        width_px=args.width,
        vehicle=args.vehicle,
        detectors=args.detectors,
    )
    found = crosscue.run_intersection_study(
        study,
        args.output,
        args.workers,
        ray=args.ray,
        attribution=not args.no_attribution,
    )
    print_result(found, args)
    return found.exit_status
