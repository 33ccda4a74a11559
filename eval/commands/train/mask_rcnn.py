r"""Train a Mask R-CNN on COCO annotations, either a compact one from scratch or an existing one.

OUT is a checkpoint (.safetensors) for the detector mask-rcnn. The training curve (JSON and PNG) is
written next to it and, until the training ends, so is the state that --resume continues from.
With --measure, nothing is trained: a network's average precision (by COCO's rules), and its
precision and recall at the cues' thresholds are reported.

examples:
  crosscue train frames L0-L319 --per-layout 8 -o frames
  crosscue train frames L900-L959 --per-layout 5 -o held_out
  crosscue train mask-rcnn --data frames/coco.json --images frames/images \
      --val-data held_out/coco.json --val-images held_out/images -o mine.safetensors
  crosscue train mask-rcnn --data own.json --images photos --init resnet50 -o own.safetensors
  crosscue train mask-rcnn --measure embedded --data held_out/coco.json --images held_out/images
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import print_result, progress_line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    _add_file_arguments(parser)
    _add_network_arguments(parser)
    _add_schedule_arguments(parser)
    _add_sampling_arguments(parser)
    parser.add_argument(
        "--check-every",
        type=int,
        default=500,
        metavar="N",
        help="steps between validations (default: 500)",
    )
    parser.add_argument(
        "--check-images",
        type=int,
        default=60,
        metavar="N",
        help="images per validation during training (default: 60)",
    )
    parser.add_argument(
        "--device",
        default="auto",
        choices=("auto", "cpu", "cuda", "mps"),
        help="device to train on (default: auto)",
    )
    parser.add_argument(
        "--threads", type=int, default=1, metavar="N", help="CPU threads (default: 1)"
    )
    parser.add_argument("--resume", action="store_true", help="continue an interrupted training")
    parser.add_argument("--overwrite", action="store_true", help="replace existing results")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def _add_file_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--data", type=Path, required=True, metavar="COCO", help="annotations to train on"
    )
    parser.add_argument(
        "--images", type=Path, required=True, metavar="DIR", help="folder of their images"
    )
    parser.add_argument(
        "--val-data",
        type=Path,
        metavar="COCO",
        help="annotations to validate on (default: every 10th image of --data)",
    )
    parser.add_argument("--val-images", type=Path, metavar="DIR", help="folder of their images")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="OUT.safetensors", help="checkpoint to write"
    )


def _add_network_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--measure",
        metavar="NETWORK",
        help="measure this network instead of training; names as for --init",
    )
    parser.add_argument(
        "--subset", metavar="A:B:N", help="measure on these images of --data: ::4 is every 4th"
    )
    parser.add_argument(
        "--proposals",
        type=int,
        nargs="+",
        default=[100],
        metavar="N",
        help="measure with N region proposals; may have several values (default: 100)",
    )
    parser.add_argument(
        "--init",
        default="compact",
        metavar="NETWORK",
        help="initial weights: compact, resnet50, resnet50-v2, embedded, or a file",
    )
    parser.add_argument(
        "--backend",
        default="torch",
        choices=("torch", "openvino"),
        help="inference engine to measure with (default: torch)",
    )


def _add_schedule_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--classes",
        nargs="+",
        default=["car", "stop sign", "traffic light"],
        metavar="NAME",
        help="classes to train (default: car, stop sign, traffic light)",
    )
    parser.add_argument(
        "--steps", type=int, default=4000, metavar="N", help="training steps (default: 4000)"
    )
    parser.add_argument(
        "--batch", type=int, default=8, metavar="N", help="images per batch (default: 8)"
    )
    parser.add_argument(
        "--learning-rate",
        type=float,
        default=1e-3,
        metavar="R",
        help="max learning rate (default: 0.001)",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")


def _add_sampling_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--width",
        type=int,
        default=1280,
        metavar="PX",
        help="width that images are scaled to (default: 1280)",
    )
    parser.add_argument(
        "--crop-top",
        type=float,
        default=0.0,
        metavar="FRACTION",
        help="top fraction of the image to skip",
    )
    parser.add_argument(
        "--crop-bottom",
        type=float,
        default=0.0,
        metavar="FRACTION",
        help="bottom fraction of the image to skip",
    )
    parser.add_argument(
        "--window",
        type=int,
        nargs=2,
        default=[544, 288],
        metavar=("W", "H"),
        help="width and height of the training windows, in pixels (default: 544 288)",
    )
    parser.add_argument(
        "--balance",
        type=float,
        default=1.0,
        metavar="FRACTION",
        help="0 samples every object equally often, 1 every class (default: 1)",
    )


def run(args: argparse.Namespace) -> int:
    """Train or measure a network."""
    if args.measure is not None:
        return _measure(args)
    if args.output is None:
        raise crosscue.UsageError("train mask-rcnn: expected -o OUT.safetensors, or --measure")
    # With --json, stdout contains nothing but the result.
    show = partial(print, file=sys.stderr if args.json else sys.stdout, flush=True)
    found = crosscue.train_mask_rcnn(
        _settings(args),
        args.output,
        resume=args.resume,
        overwrite=args.overwrite,
        on_line=(lambda text: None) if args.quiet else show,
    )
    print_result(found, args)
    return 0


def _measure(args: argparse.Namespace) -> int:
    if args.output is not None or args.val_data is not None:
        raise crosscue.UsageError(
            "--measure: cannot be combined with -o or --val-data, because nothing is trained"
        )
    with progress_line(args, "measuring") as line:
        found = crosscue.measure_mask_rcnn(
            args.measure,
            args.data,
            args.images,
            subset=args.subset,
            proposals=args.proposals,
            backend=args.backend,
            device=args.device,
            threads=args.threads,
            on_measured=line.counting("measurements"),
        )
    print_result(found, args)
    return 0


def _settings(args: argparse.Namespace) -> crosscue.MaskRcnnTrainingSettings:
    return crosscue.MaskRcnnTrainingSettings(
        data=args.data,
        images=args.images,
        val_data=args.val_data,
        val_images=args.val_images,
        init=args.init,
        classes=args.classes,
        steps=args.steps,
        batch=args.batch,
        learning_rate=args.learning_rate,
        seed=args.seed,
        width_px=args.width,
        crop_top=args.crop_top,
        crop_bottom=args.crop_bottom,
        window_px=tuple(args.window),
        balance=args.balance,
        check_every=args.check_every,
        check_images=args.check_images,
        device=args.device,
        threads=args.threads,
    )
