r"""Train a Mask R-CNN on COCO annotations: a compact one from nothing, or go on with another.

OUT is a checkpoint (.safetensors) for the detector mask-rcnn. Beside it lie OUT's curve (JSON and
PNG) and, until the training ends, the state that --resume goes on with. --measure trains nothing:
it reports average precision (COCO's rules), and precision and recall at the scores that cues take.

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
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from crosscue.detectors.training.summary import measured_text, measured_tree
from crosscue.eval.commands.shared.options import print_json
from crosscue.eval.interface.training.inputs import check_place
from crosscue.replay.base import UsageError
from crosscue.replay.files.made_of import made_of

if TYPE_CHECKING:
    from crosscue.detectors.networks.mask_rcnn.checkpoint import Facts
    from crosscue.detectors.training.annotations import LabelledSet
    from crosscue.detectors.training.job import Job, Point

CLASSES = ("car", "stop sign", "traffic light")
EVERY = 10
PROPOSALS = 100
"""The detector's own."""
MAX_WINDOW_PX = 4096
"""As wide as the widest picture."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
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
        help=f"annotations to validate on (default: every {EVERY}th image of --data)",
    )
    parser.add_argument("--val-images", type=Path, metavar="DIR", help="folder of their images")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="OUT.safetensors", help="checkpoint to write"
    )
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
        default=[PROPOSALS],
        metavar="N",
        help="measure with N region proposals; several values in turn (default: 100)",
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
    parser.add_argument(
        "--classes", nargs="+", default=list(CLASSES), metavar="NAME", help="classes to train"
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
        help="width and height of the training windows, in pixels",
    )
    parser.add_argument(
        "--balance",
        type=float,
        default=1.0,
        metavar="FRACTION",
        help="0 samples every object equally often, 1 every class",
    )
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


def run(args: argparse.Namespace) -> int:
    """Train."""
    from crosscue.detectors.training.job import run_job

    _check(args)
    if args.measure is not None:
        return _measure(args)
    job = _job(args)
    check_place(args.output)
    train, held_out = _sets(args)
    if not args.quiet:
        for name, one in (("training", train), ("held out", held_out)):
            left = ", ".join(f"{count} {why}" for why, count in sorted(one.left_out.items()))
            said = f"{name}: {len(one.pictures)} pictures" + (f"; {left}" if left else "")
            print(said, file=_talk(args), flush=True)

    def tell(point: Point) -> None:
        if not args.quiet:
            print(
                f"step {point.step} of {args.steps}: loss {point.loss:.3f}, "
                f"box AP {point.ap.get('box')}, mask AP {point.ap.get('mask')}, "
                f"{point.seconds:.0f} s",
                file=_talk(args),
                flush=True,
            )

    facts = run_job(job, train, held_out, resume=args.resume, overwrite=args.overwrite, tell=tell)
    _draw(job)
    _report(facts, job, args)
    return 0


def _check(args: argparse.Namespace) -> None:
    if args.measure is not None:
        if args.output is not None or args.val_data is not None:
            raise UsageError("--measure: trains nothing, so not with -o or --val-data; leave those")
        if not all(1 <= count <= 2000 for count in args.proposals):
            raise UsageError("--proposals: expected 1 to 2000")
        return
    if args.output is None:
        raise UsageError("train mask-rcnn: give -o OUT.safetensors, or --measure")
    if args.output.suffix != ".safetensors":
        raise UsageError(f"-o {args.output}: expected a name that ends in .safetensors")
    for name in ("steps", "batch", "check_every", "check_images", "threads"):
        if getattr(args, name) < 1:
            raise UsageError(f"--{name.replace('_', '-')}: expected 1 or more")
    if not 0.0 < args.learning_rate < 1.0 or args.seed < 0:
        raise UsageError(
            "--learning-rate, --seed: expected a rate between 0 and 1, and a seed of 0 or more"
        )
    if not 0.0 <= args.balance <= 1.0:
        raise UsageError(f"--balance {args.balance}: expected 0 to 1")
    if any(side % 32 or not 64 <= side <= MAX_WINDOW_PX for side in args.window):
        raise UsageError(
            f"--window {args.window[0]} {args.window[1]}: expected multiples of 32 from 64 to "
            f"{MAX_WINDOW_PX}"
        )
    if not all(args.classes) or len(set(args.classes)) != len(args.classes):
        raise UsageError("--classes: one is empty or named twice; name each once")
    if (args.val_data is None) != (args.val_images is None):
        raise UsageError("--val-data, --val-images: give both or none")


def _talk(args: argparse.Namespace) -> TextIO:
    """Where progress is printed: JSON is alone on standard output."""
    return sys.stderr if args.json else sys.stdout


def _measure(args: argparse.Namespace) -> int:
    """Measure how good a network is."""
    from dataclasses import replace

    from crosscue.detectors.devices import chosen_device
    from crosscue.detectors.networks.mask_rcnn.detector import MaskRcnnSettings, checkpoint_named
    from crosscue.detectors.training.annotations import read_coco
    from crosscue.detectors.training.measure import measure

    asked = args.device if args.backend == "torch" else "cpu"
    device = chosen_device(asked, "train mask-rcnn")
    checkpoint = checkpoint_named(args.measure)
    classes = [name for name in checkpoint.facts.plan.classes if name]
    whole = read_coco(args.data, args.images, classes)
    labelled = replace(whole, pictures=whole.pictures[_slice(args.subset)])
    if not labelled.pictures:
        count = len(whole.pictures)
        raise UsageError(f"--subset {args.subset}: none of {count} pictures; name others")
    reported = []
    for proposals in args.proposals:
        settings = MaskRcnnSettings(proposals=proposals, threads=args.threads, backend=args.backend)
        reached = measure(checkpoint, labelled, settings, device)
        reported.append(measured_tree(proposals, reached))
        if not args.quiet and not args.json:
            print(measured_text(args.measure, len(labelled.pictures), proposals, reached))
    if args.json:
        print_json(
            {"network": args.measure, "pictures": len(labelled.pictures), "measured": reported}
        )
    return 0


def _slice(text: str | None) -> slice:
    """Of ``A:B:N``, any of which may be missing.

    Raises:
        UsageError: It is not one.
    """
    match = re.fullmatch(r"(\d{0,9}):(\d{0,9})(?::([1-9]\d{0,8})?)?", text or ":")
    if match is None:
        raise UsageError(f"--subset {text}: expected A:B:N, as 300: or 300:600 or ::4")
    return slice(*(int(part) if part else None for part in match.groups()))


def _sets(args: argparse.Namespace) -> tuple[LabelledSet, LabelledSet]:
    from dataclasses import replace

    from crosscue.detectors.training.annotations import read_coco

    whole = read_coco(args.data, args.images, args.classes)
    if args.val_data is not None:
        return whole, read_coco(args.val_data, args.val_images, args.classes)
    held_out = whole.pictures[::EVERY]
    rest = tuple(one for i, one in enumerate(whole.pictures) if i % EVERY)
    if not rest:
        raise UsageError(f"{args.data}: one picture is too little; give more, or --val-data")
    return replace(whole, pictures=rest), replace(whole, pictures=held_out)


def _job(args: argparse.Namespace) -> Job:
    from pydantic import ValidationError

    from crosscue.detectors.networks.mask_rcnn.network import Plan
    from crosscue.detectors.training.job import Job, architecture_of
    from crosscue.detectors.training.loop import Schedule
    from crosscue.detectors.training.samples import Window

    try:
        plan = Plan.model_validate(
            {
                "architecture": architecture_of(args.init),
                "classes": args.classes,
                "width_px": args.width,
                "top": args.crop_top,
                "bottom": args.crop_bottom,
            }
        )
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = ".".join(str(part) for part in first["loc"]) or "--crop-top, --crop-bottom"
        raise UsageError(f"train mask-rcnn: {name}: {first['msg'].lower()}") from None
    schedule = Schedule(
        args.steps, args.batch, args.learning_rate, min(100, args.steps), seed=args.seed
    )
    window = Window(args.window[0], args.window[1], balance=args.balance)
    return Job(
        args.init,
        plan,
        schedule,
        window,
        args.output,
        args.check_every,
        args.check_images,
        args.device,
        args.threads,
        {"data": args.data.parent.name, "window": str(args.window), "balance": args.balance},
        _made_of(args),
    )


def _made_of(args: argparse.Namespace) -> dict[str, Any]:
    """Annotations, pictures, weights to begin with, and settings: what decides the training."""
    places = [args.data, args.images, args.val_data, args.val_images]
    if (start := Path(args.init)).is_file():
        places.append(start)
    names = ("classes", "steps", "batch", "learning_rate", "seed", "width", "window", "balance")
    more = ("crop_top", "crop_bottom", "check_every", "check_images")
    return made_of(
        [path for path in places if path is not None],
        {name: getattr(args, name) for name in (*names, *more)}
        | {"init": start.name if start.is_file() else args.init},
    )


def _draw(job: Job) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    from crosscue.detectors.training.job import read_curve
    from crosscue.replay.base import write_whole

    points = read_curve(job.curve_path)
    figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(7, 6))
    steps = [point.step for point in points]
    above.plot(steps, [point.loss for point in points], marker=".")
    above.set_ylabel("loss")
    for name in ("box", "mask", "box50", "mask50"):
        below.plot(steps, [point.ap.get(name) for point in points], marker=".", label=name)
    below.set(xlabel="step", ylabel="average precision, %", ylim=(0, 100))
    below.legend()
    figure.tight_layout()
    write_whole(
        job.output.with_suffix(".curve.png"),
        lambda path: figure.savefig(path, format="png", dpi=100),
    )
    plt.close(figure)


def _report(facts: Facts, job: Job, args: argparse.Namespace) -> None:
    if args.json:
        print_json(facts.model_dump(mode="json"))
    elif not args.quiet:
        size = job.output.stat().st_size / 1e6
        print(
            f"{job.output}: {size:.1f} MB, box AP {facts.measured['box']}, "
            f"mask AP {facts.measured['mask']}"
        )
