"""Simulate drives up to intersections: log with camera, CAN, Mobileye and compass, truth beside.

Layouts A to H are those of the published study; L0, L1, ... are others, from seeds, for training.
The same names and seeds give the same bytes.

examples:
  crosscue simulate A --run 3 -o drives
  crosscue simulate --all -o drives
  crosscue simulate L17 L18 --runs 2 --seed 5 -o training
  crosscue simulate --all --sheet sheet.jpg
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from crosscue.datasets.scenes.drive import (
    SceneFiles,
    SceneSettings,
    refuse_other_drive,
    write_scene,
)
from crosscue.datasets.scenes.export.contact_sheet import contact_sheet, sheet_jpeg
from crosscue.datasets.scenes.layout import SCORED
from crosscue.datasets.scenes.rendering.camera import Camera
from crosscue.eval.commands.shared.options import print_json
from crosscue.eval.commands.shared.progress import Done, with_progress
from crosscue.replay.base import OutputError, UsageError, write_bytes
from crosscue.replay.processes import in_processes

PUBLISHED_RUNS = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument(
        "layouts", nargs="*", metavar="LAYOUT", help="layouts: A to H, or L0, L1 and so on"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="folder that gets one folder per drive"
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
    """Simulate all that was asked for."""
    wanted = _wanted(args)
    if args.sheet is not None:
        return _sheet(wanted, args)
    written: list[dict[str, object]] = []

    def at() -> Done:
        return Done(len(written), len(wanted), "drives")

    for settings, files in with_progress(_made(wanted, args), at, args, "simulating"):
        written.append(_report_text(settings, files))
        if not args.quiet and not args.json:
            print(f"{files.log.parent}: {files.seconds:.1f} s, {files.pictures} pictures")
    if args.json:
        print_json(written)
    return 0


def _made(
    wanted: list[SceneSettings], args: argparse.Namespace
) -> Iterator[tuple[SceneSettings, SceneFiles]]:
    """Drives in the order asked for, several made at a time."""
    for settings in wanted if args.overwrite else ():
        refuse_other_drive(args.output / settings.name, settings)
    make = partial(_make, output=args.output, overwrite=args.overwrite)
    return zip(wanted, in_processes(make, wanted, args.workers), strict=True)


def _make(settings: SceneSettings, output: Path, overwrite: bool) -> SceneFiles:
    return write_scene(output / settings.name, settings, overwrite=overwrite)


def _sheet(wanted: list[SceneSettings], args: argparse.Namespace) -> int:
    columns = len({(one.run, one.seed) for one in wanted})
    if args.sheet.exists() and not args.overwrite:
        raise OutputError(f"{args.sheet}: exists; give another name or --overwrite")
    coded = sheet_jpeg(contact_sheet(wanted, columns))
    write_bytes(args.sheet, coded)
    if args.json:
        print_json({"sheet": str(args.sheet), "drives": [one.name for one in wanted]})
    elif not args.quiet:
        print(args.sheet)
    return 0


def _wanted(args: argparse.Namespace) -> list[SceneSettings]:
    if args.all == bool(args.layouts):
        raise UsageError("simulate: give layouts (A to H, L0, L1, ...), or --all")
    if len(set(args.layouts)) != len(args.layouts):
        raise UsageError("simulate: a layout is named twice; name each once")
    if (args.output is None) == (args.sheet is None):
        raise UsageError("simulate: give -o DIR for drives, or --sheet JPEG for pictures of them")
    if args.workers < 1:
        raise UsageError(f"--workers {args.workers}: want 1 or more")
    if args.run is not None and (args.runs is not None or args.all):
        raise UsageError("--run: not together with --runs or --all; give one of them")
    if not 64 <= args.width <= 3840 or args.width % 16:
        raise UsageError(f"--width {args.width}: want a multiple of 16 from 64 to 3840")
    layouts = list(SCORED) if args.all else args.layouts
    last = args.runs if args.runs is not None else PUBLISHED_RUNS if args.all else 1
    if last < 1:
        raise UsageError(f"--runs {last}: want 1 or more")
    runs = [args.run] if args.run is not None else list(range(1, last + 1))
    camera = Camera(width_px=args.width, height_px=args.width * 9 // 16)
    try:
        return [
            SceneSettings(layout=layout, run=run, seed=args.seed, rate_hz=args.fps, camera=camera)
            for layout in layouts
            for run in runs
        ]
    except ValueError as error:
        raise UsageError(f"simulate: {error}") from None


def _report_text(settings: SceneSettings, files: SceneFiles) -> dict[str, object]:
    return {
        "name": settings.name,
        "log": str(files.log),
        "vehicle": str(files.vehicle),
        "truth": str(files.truth),
        "pictures": files.pictures,
        "seconds": files.seconds,
    }
