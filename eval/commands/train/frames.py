"""Pictures of simulated intersections with COCO annotations, to train networks on.

Takes a few pictures of each of many runs: OUT/coco.json and OUT/images. Layouts are L and a number;
A to H are those that crosscue is scored on, so nothing may learn from them.

examples:
  crosscue train frames L0-L299 --per-layout 8 -o frames
  crosscue train frames L900-L949 --per-layout 4 -o held_out
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crosscue.datasets.scenes.drive import SOURCE, SceneSettings, camera_of_width
from crosscue.datasets.scenes.export.coco import Objects
from crosscue.datasets.scenes.export.training_frames import frames, joined
from crosscue.eval.commands.shared.options import print_json
from crosscue.eval.commands.shared.progress import Done, with_progress
from crosscue.eval.commands.shared.training import check_place, learnt_layouts_of
from crosscue.replay.errors import OutputError, UsageError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument(
        "layouts", nargs="+", metavar="LAYOUT", help="layouts: L0, L17 or a span, L0-L99"
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
    """Render and write."""
    if args.per_layout < 1 or args.workers < 1 or args.seed < 0:
        raise UsageError("--per-layout, --workers: expected 1 or more; --seed: expected 0 or more")
    wanted = [_settings(name, args) for name in learnt_layouts_of(args.layouts, "train frames")]
    target = args.output / "coco.json"
    if target.exists():
        raise OutputError(f"{target}: exists; give another folder")
    images = args.output / "images"
    check_place(images / "any")
    parts: list[Objects] = []
    made = frames(wanted, args.per_layout, images, args.workers)

    def at() -> Done:
        return Done(len(parts), len(wanted), "runs")

    for part in with_progress(made, at, args, "rendering"):
        parts.append(part)
    whole = joined(parts)
    whole.save(target, f"{SOURCE}; layouts {' '.join(args.layouts)}, seed {args.seed}")
    reported = {
        "coco": str(target),
        "pictures": len(whole.images),
        "objects": len(whole.annotations),
    }
    if args.json:
        print_json(reported)
    elif not args.quiet:
        print(f"{target}: {reported['pictures']} pictures, {reported['objects']} objects")
    return 0


def _settings(layout: str, args: argparse.Namespace) -> SceneSettings:
    # Conditions come in ten kinds; layout and run count up together, so each kind comes as often.
    run = int(layout[1:]) % 10 + 1
    camera = camera_of_width(args.width)
    return SceneSettings(layout=layout, run=run, seed=args.seed, camera=camera)
