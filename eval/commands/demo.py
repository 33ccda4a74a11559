"""Replay a drive to an intersection from its pictures, score it, and show the result.

By default, the drive is simulated on this machine from a seed, and nothing is downloaded. This
takes a few minutes on two cores, mostly for rendering and for the networks. With --real, the drive
is 8 s of San Francisco: PandaSet's sequence 002 (Scale AI and Hesai, CC BY 4.0, 20.8 MB), annotated
by crosscue's authors, with the network yolox-nano (3.7 MB, Apache-2.0). Both are downloaded once
and verified.

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
from crosscue.eval.commands.shared.terminal import (
    Done,
    print_json,
    progress_line,
)
from crosscue.replay.safe_text import visible


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="DIR",
        help="folder for drive, run and report (default: demo, or demo-real)",
    )
    parser.add_argument("--real", action="store_true", help="replay a real drive, downloaded once")
    parser.add_argument(
        "--data",
        dest="source",
        type=Path,
        metavar="FOLDER",
        help="folder with the real drive and the weights, to use instead of downloading them",
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
    """Fetch or simulate a drive, then replay, score and show it."""
    _check(args)
    talk = not (args.quiet or args.json)
    layout = args.layout or "C"
    if talk and not args.real:
        print(f"simulating a drive up to intersection {layout} ...", flush=True)
    with progress_line(args, "fetching") as fetching:

        def on_drive(drive: crosscue.KnownDrive) -> None:
            fetching.end()
            if talk and not args.real:
                print(f"  {drive.log}\n", flush=True)

        made = crosscue.demo(
            args.output,
            real=args.real,
            source=args.source,
            layout=layout,
            run=1 if args.run is None else args.run,
            seed=0 if args.seed is None else args.seed,
            width_px=1280 if args.width is None else args.width,
            overwrite=args.overwrite,
            on_fetch=lambda file, done, of: fetching.at(Done(done / 1e6, of / 1e6, "MB"), file),
            on_drive=on_drive,
        )
    if args.json:
        print_json(made.as_dict())
    elif not args.quiet:
        whose = "our annotations" if args.real else "the truth of the simulation"
        print(made.run.made)
        print(f"\nagainst {whose}")
        print("\n".join(map(visible, repr(made).splitlines())))
    return made.run.made.exit_status


def _check(args: argparse.Namespace) -> None:
    if not args.real and args.source is not None:
        raise crosscue.UsageError("--data: applies only to a real drive; add --real")
    for name in ("layout", "run", "seed", "width") if args.real else ():
        if getattr(args, name) is not None:
            raise crosscue.UsageError(
                f"--{name}: applies only to a simulated drive; omit it or --real"
            )
