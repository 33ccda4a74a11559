"""Render pictures of simulated intersections with COCO annotations, for training.

Writes a few pictures of each layout to OUT/images, and their annotations to OUT/coco.json. Layouts
are L0, L1, and so on. Layouts A to H are refused, because crosscue is scored on them.

examples:
  crosscue train frames L0-L299 --per-layout 8 -o frames
  crosscue train frames L900-L949 --per-layout 4 -o held_out
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import print_result, progress_line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument(
        "layouts", nargs="+", metavar="LAYOUT", help="layouts: L0, L17 or a range, L0-L99"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder for images and annotations",
    )
    parser.add_argument(
        "--per-layout", type=int, default=8, metavar="N", help="images per layout (default: 8)"
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
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="number of layouts in parallel (default: 1)",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Render and write the pictures."""
    with progress_line(args, "rendering") as line:
        found = crosscue.render_training_frames(
            args.output,
            args.layouts,
            args.per_layout,
            args.seed,
            width_px=args.width,
            workers=args.workers,
            on_runs=line.counting("runs"),
        )
    print_result(found, args)
    return 0
