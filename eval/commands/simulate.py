"""Simulate drives to intersections: a log with camera, CAN, Mobileye and compass, and its truth.

Layouts A to H are those of the published study; L0, L1, ... are random layouts for training. The
same names and seeds yield the same bytes.

examples:
  crosscue simulate A --run 3 -o drives
  crosscue simulate --all -o drives
  crosscue simulate L17 L18 --runs 2 --seed 5 -o training
  crosscue simulate --all --sheet sheet.jpg
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import crosscue
from crosscue.datasets.scenes.layout import SCORED
from crosscue.eval.commands.shared.terminal import Done, print_json, progress_line

PUBLISHED_RUNS = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument(
        "layouts",
        nargs="*",
        metavar="LAYOUT",
        help="layouts: A to H, or L0, L1, M0, M1 and so on",
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="output folder, with one folder per drive"
    )
    parser.add_argument(
        "--sheet",
        type=Path,
        metavar="JPEG",
        help="write only a contact sheet with one frame per drive",
    )
    parser.add_argument("--run", type=int, metavar="N", help="simulate only this run, from 1")
    parser.add_argument(
        "--runs", type=int, metavar="N", help="simulate the first N runs (default: 1)"
    )
    parser.add_argument("--all", action="store_true", help="simulate A to H, ten runs each")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument(
        "--fps",
        type=int,
        default=10,
        metavar="N",
        help="camera images per second: 10, 20, 25 or 50 (default: 10)",
    )
    parser.add_argument(
        "--width",
        type=int,
        default=1280,
        metavar="PX",
        help="image width in pixels; height is 9/16 (default: 1280)",
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="number of drives in parallel (default: 1)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace existing drives")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Simulate the requested drives."""
    layouts, runs = _wanted(args)
    if args.sheet is not None:
        return _sheet(layouts, runs, args)
    with progress_line(args, "simulating") as line:

        def on_drive(files: crosscue.SceneFiles, done: int, of: int) -> None:
            if not args.quiet and not args.json:
                line.end()
                print(f"{files.log.parent}: {files.seconds:.1f} s, {files.pictures} pictures")
            line.at(Done(done, of, "drives"))

        made = crosscue.simulate_approaches(
            args.output,
            layouts,
            runs,
            args.seed,
            width_px=args.width,
            rate_hz=args.fps,
            workers=args.workers,
            overwrite=args.overwrite,
            on_drive=on_drive,
        )
    if args.json:
        print_json(made.as_dict())
    return 0


def _sheet(layouts: Sequence[str], runs: Sequence[int], args: argparse.Namespace) -> int:
    drives = crosscue.draw_contact_sheet(
        args.sheet,
        layouts,
        runs,
        args.seed,
        width_px=args.width,
        rate_hz=args.fps,
        overwrite=args.overwrite,
    )
    if args.json:
        print_json({"sheet": str(args.sheet), "drives": list(drives)})
    elif not args.quiet:
        print(args.sheet)
    return 0


def _wanted(args: argparse.Namespace) -> tuple[Sequence[str], Sequence[int]]:
    """Return the requested layouts, and the runs of each."""
    if args.all == bool(args.layouts):
        raise crosscue.UsageError(
            "simulate: expected layouts (A to H, L0, L1, ..., M0, M1, ...), or --all"
        )
    if (args.output is None) == (args.sheet is None):
        raise crosscue.UsageError(
            "simulate: expected -o DIR for drives, or --sheet JPEG for pictures of them"
        )
    if args.run is not None and (args.runs is not None or args.all):
        raise crosscue.UsageError("--run: cannot be combined with --runs or --all; use one of them")
    last = args.runs if args.runs is not None else PUBLISHED_RUNS if args.all else 1
    if last < 1:
        raise crosscue.UsageError(f"--runs {last}: expected 1 or more")
    runs = [args.run] if args.run is not None else list(range(1, last + 1))
    return list(SCORED) if args.all else args.layouts, runs
