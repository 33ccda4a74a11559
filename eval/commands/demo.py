"""Replay a drive up to an intersection from its pictures, score it, show it.

The drive is simulated from a seed on this machine, and nothing is downloaded; that takes a few
minutes on two cores, most of them for the pictures and the networks. With --real it is 8 s of San
Francisco: PandaSet's sequence 002 (Scale AI and Hesai, CC BY 4.0, 20.8 MB) with the network
yolox-nano (3.7 MB, Apache-2.0), both fetched once and checked, and annotated by us.

example:
  crosscue demo -o demo
  crosscue demo --real
  crosscue demo --real --data FOLDER       on a machine without network
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.datasets.scenes.layout import SCORED
from crosscue.eval.commands.shared.options import print_json
from crosscue.eval.commands.shared.progress import (
    Done,
    DriveLine,
    is_shown,
    progress_line,
)
from crosscue.eval.interface.demo import show_drive, simulated
from crosscue.replay.base import UsageError, visible


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="DIR",
        help="folder for drive, run and report (default: demo, or demo-real)",
    )
    parser.add_argument("--real", action="store_true", help="replay a real drive, fetched once")
    parser.add_argument(
        "--data",
        dest="source",
        type=Path,
        metavar="FOLDER",
        help="take the real drive and the weights from this folder; no network is used",
    )
    parser.add_argument("--layout", choices=SCORED, help="layout of the intersection (default: C)")
    parser.add_argument(
        "--run", type=int, metavar="N", help="run of the layout, from 1 (default: 1)"
    )
    parser.add_argument("--seed", type=int, metavar="N", help="random seed (default: 0)")
    parser.add_argument(
        "--width",
        type=int,
        metavar="PX",
        help="image width in pixels (default: 1280); height is 9/16",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing demo")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Fetch or simulate, replay, score, show."""
    folder = args.output or Path("demo-real" if args.real else "demo")
    drive = _fetched(args) if args.real else _simulated(args, folder)
    with DriveLine("replaying", is_shown=is_shown(args)) as line:
        made = show_drive(drive, folder, args.overwrite, line.at_frame, line.at_time)
    if args.json:
        print_json(made.as_dict())
    elif not args.quiet:
        whose = "our annotations" if args.real else "the truth of the simulation"
        print(made.run.made)
        print(f"\nagainst {whose}")
        print("\n".join(map(visible, repr(made).splitlines())))
    return made.run.made.exit_status


def _fetched(args: argparse.Namespace) -> crosscue.KnownDrive:
    for name in ("layout", "run", "seed", "width"):
        if getattr(args, name) is not None:
            raise UsageError(f"--{name}: for a simulated drive; leave it or --real out")
    with progress_line(args, "fetching") as line:
        return crosscue.fetch_drive(
            args.source,
            on_fetch=lambda file, done, of: line.at(Done(done / 1e6, of / 1e6, "MB"), file),
        )


def _simulated(args: argparse.Namespace, folder: Path) -> crosscue.KnownDrive:
    if args.source is not None:
        raise UsageError("--data: for a real drive; add --real")
    width = 1280 if args.width is None else args.width
    if not 64 <= width <= 3840 or width % 16:
        raise UsageError(f"--width {width}: expected a multiple of 16 from 64 to 3840")
    talk = not (args.quiet or args.json)
    layout = args.layout or "C"
    if talk:
        print(f"simulating a drive up to intersection {layout} ...", flush=True)
    drive = simulated(
        folder,
        layout,
        1 if args.run is None else args.run,
        0 if args.seed is None else args.seed,
        width_px=width,
        overwrite=args.overwrite,
    )
    if talk:
        print(f"  {drive.log}\n", flush=True)
    return drive
