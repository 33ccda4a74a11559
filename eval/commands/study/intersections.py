"""The published experiment on simulated drives: distances, cues and beliefs beside the text's.

Simulates every drive, replays it from its pixels with the embedded detectors, scores it, and
writes study.html, study.json and score/metrics.json. A second start does only what is missing.

example:
  crosscue study intersections -o study --runs 10 --workers 2
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crosscue.datasets.scenes.layout import SCORED
from crosscue.detectors.registry import EMBEDDED
from crosscue.eval.batch.engine import engine_of
from crosscue.eval.batch.jobs import exit_status_of
from crosscue.eval.commands.shared.progress import DrivesLine, is_shown
from crosscue.eval.studies.intersections.report import TABLES, summary, write_study
from crosscue.eval.studies.intersections.study import StudySettings, run_drives, score_study
from crosscue.replay.base import RunError, visible


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
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
    """Simulate, replay, score; 3 when a drive failed."""
    engine = engine_of(args.workers, args.ray)
    settings = StudySettings(
        layouts=tuple(name.strip() for name in args.layouts.split(",") if name.strip()),
        runs=args.runs,
        seed=args.seed,
        width_px=args.width,
        vehicle=args.vehicle,
        detectors=args.detectors,
    )
    with DrivesLine("driving", is_shown=is_shown(args)) as line:
        done = run_drives(args.output, settings, engine, line)
    names = [one.job.name for one in done if one.error is None]
    if not names:
        raise RunError(f"{args.output}: every drive failed; the first: {done[0].error}")
    scored = score_study(args.output, names, attribution=not args.no_attribution)
    written = write_study(args.output, settings, done, scored)
    if args.json:
        print((args.output / TABLES).read_text(encoding="utf-8"), end="")
    elif not args.quiet:
        print("\n".join(visible(text) for text in summary(done, scored, written).split("\n")))
    return exit_status_of(done)
