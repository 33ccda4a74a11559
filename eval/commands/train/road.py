r"""Train the road network on simulated intersections or on your own images with masks.

Simulated images: --per-layout images of each of --layouts (L0, L1, and so on) are rendered to train
on, and other layouts, --val-layouts, to validate on. Layouts A to H are allowed only as
--test-layouts. Your own images: --data is a folder with images/NAME.jpg and masks/NAME.png, white
where there is road; every tenth image is held out. --measure measures a network on --test-layouts
or --data, without training.

examples:
  crosscue train road --layouts L400-L519 --val-layouts L600-L611 \
      --test-layouts A-H -o road.safetensors
  crosscue train road --data my_frames --init road.safetensors -o mine.safetensors
  crosscue train road --measure embedded --test-layouts A-H
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import Done, print_result, progress_line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument(
        "--layouts",
        nargs="+",
        metavar="LAYOUT",
        help="layouts to train on: L400 or a range, L400-L519",
    )
    parser.add_argument(
        "--val-layouts",
        nargs="+",
        metavar="LAYOUT",
        default=[],
        help="layouts to validate on, different from --layouts",
    )
    parser.add_argument(
        "--test-layouts",
        nargs="+",
        metavar="LAYOUT",
        default=[],
        help="layouts to measure on at the end, such as A-H",
    )
    parser.add_argument(
        "--data", type=Path, metavar="DIR", help="folder with your own images/ and masks/"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="OUT.safetensors", help="checkpoint to write"
    )
    parser.add_argument(
        "--measure",
        metavar="NETWORK",
        help="measure this network instead of training: embedded, or a file",
    )
    parser.add_argument("--init", type=Path, metavar="FILE", help="initial weights")
    parser.add_argument(
        "--resume", action="store_true", help="continue an interrupted training from OUT.state"
    )
    parser.add_argument(
        "--per-layout", type=int, default=12, metavar="N", help="images per layout (default: 12)"
    )
    parser.add_argument(
        "--steps", type=int, default=1500, metavar="N", help="training steps (default: 1500)"
    )
    parser.add_argument(
        "--stop-at", type=int, metavar="N", help="stop after N steps of the schedule"
    )
    parser.add_argument(
        "--batch", type=int, default=12, metavar="N", help="images per batch (default: 12)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument(
        "--width",
        type=int,
        default=384,
        metavar="PX",
        help="input width in pixels; height is 9/16 (default: 384)",
    )
    parser.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda", "mps"),
        default="auto",
        help="device to train on (default: auto)",
    )
    parser.add_argument(
        "--threads", type=int, default=0, metavar="N", help="CPU threads; 0 for all (default: 0)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing OUT")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Train or measure a network."""
    with progress_line(args, "training") as line:

        def rendered(done: int, of: int) -> None:
            line.at(Done(done, of, "runs"), "rendering")

        if args.measure is not None:
            if args.output is not None or args.layouts is not None:
                raise crosscue.UsageError(
                    "--measure: cannot be combined with -o or --layouts, because nothing is trained"
                )
            found = crosscue.measure_road(
                args.measure,
                test_layouts=args.test_layouts,
                data=args.data,
                per_layout=args.per_layout,
                seed=args.seed,
                device=args.device,
                on_runs=rendered,
            )
        elif args.output is None:
            raise crosscue.UsageError("train road: expected -o OUT.safetensors, or --measure")
        else:
            found = crosscue.train_road(
                _settings(args),
                args.output,
                resume=args.resume,
                overwrite=args.overwrite,
                on_runs=rendered,
                on_steps=line.counting("steps"),
            )
    print_result(found, args)
    return 0


def _settings(args: argparse.Namespace) -> crosscue.RoadTrainingSettings:
    return crosscue.RoadTrainingSettings(
        layouts=args.layouts or (),
        val_layouts=args.val_layouts,
        test_layouts=args.test_layouts,
        data=args.data,
        init=args.init,
        per_layout=args.per_layout,
        steps=args.steps,
        stop_at=args.stop_at,
        batch=args.batch,
        seed=args.seed,
        width_px=args.width,
        device=args.device,
        threads=args.threads,
    )
