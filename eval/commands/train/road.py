r"""Train the road network on simulated intersections or on your own images with masks.

Simulated: renders --per-layout images of each layout of --layouts (L and a number) and validates on
other layouts, --val-layouts. Layouts A to H are for --test-layouts only. Your own: a folder --data
with images/NAME.jpg and masks/NAME.png, white where road is; every tenth image is held out.
--measure reports how well a network does on --test-layouts or --data, without training.

examples:
  crosscue train road --layouts L400-L519 --val-layouts L600-L611 \
      --test-layouts A-H -o road.safetensors
  crosscue train road --data my_frames --init road.safetensors -o mine.safetensors
  crosscue train road --measure embedded --test-layouts A-H
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from crosscue.datasets.scenes.drive import SceneSettings
from crosscue.datasets.scenes.export.road_frames import RoadFrames, joined, rendered
from crosscue.datasets.scenes.layout import SCORED
from crosscue.datasets.scenes.rendering.camera import Camera
from crosscue.eval.commands.shared.options import print_json
from crosscue.eval.commands.shared.progress import Done, with_progress
from crosscue.eval.interface.training.inputs import check_place, layouts_of, learnt_layouts_of
from crosscue.replay.errors import OutputError, UsageError
from crosscue.replay.files.made_of import made_of

if TYPE_CHECKING:
    import torch

    from crosscue.detectors.networks.road.network import RoadNetwork
    from crosscue.detectors.training.road import RoadTraining

Size: TypeAlias = tuple[int, int]
"""Width and height, pixels."""
HELD_EVERY = 10
SAVED_EVERY = 100


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument(
        "--layouts",
        nargs="+",
        metavar="LAYOUT",
        help="layouts to train on: L400 or a span, L400-L519",
    )
    parser.add_argument(
        "--val-layouts",
        nargs="+",
        metavar="LAYOUT",
        default=[],
        help="layouts to validate on, none of them trained on",
    )
    parser.add_argument(
        "--test-layouts",
        nargs="+",
        metavar="LAYOUT",
        default=[],
        help="further layouts to measure on at the end, such as A-H",
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
    """Render or read, train, measure, write."""
    _check(args)
    if args.measure is not None:
        return _measure(args)
    import torch

    from crosscue.detectors.devices import chosen_device
    from crosscue.detectors.networks.road.checkpoint import RoadFacts, load_road, save_road
    from crosscue.detectors.training.reproducible import decides_bits, reproducible
    from crosscue.detectors.training.road import RoadSchedule, RoadTraining

    if args.threads:
        torch.set_num_threads(args.threads)
    check_place(args.output)
    size = _size(args)
    learn, held = _frames(args)
    schedule = RoadSchedule(args.steps, args.batch, seed=args.seed)
    device = chosen_device(args.device, "train road")
    with reproducible(device):
        training = RoadTraining(schedule, device)
        if args.init is not None:
            training.network.load_state_dict(load_road(args.init).network.state_dict())
        loss = _trained(training, learn, args)
    recipe: dict[str, str | int | float] = {
        "layouts": " ".join(args.layouts or []),
        "pictures": len(learn),
        "steps": args.steps,
        "stopped_at": training.done,
        "batch": args.batch,
        "seed": args.seed,
        "loss": round(loss, 5),
        **_measured(training.network, training.device, "held_out", held),
        **_measured(training.network, training.device, "scored", _scored(args, size)),
        **decides_bits(device),
    }
    facts = RoadFacts(width_px=size[0], height_px=size[1], recipe=recipe)
    save_road(args.output, training.network, facts)
    _state(args).unlink(missing_ok=True)
    _report(str(args.output), recipe, args)
    return 0


def _check(args: argparse.Namespace) -> None:
    if args.width % 16 or not 128 <= args.width <= 1024:
        raise UsageError(f"--width {args.width}: expected a multiple of 16 from 128 to 1024")
    if min(args.per_layout, args.steps, args.batch, args.stop_at or 1) < 1:
        raise UsageError("--per-layout, --steps, --stop-at, --batch: expected 1 or more")
    if min(args.seed, args.threads) < 0:
        raise UsageError("--seed, --threads: expected 0 or more")
    layouts_of(args.test_layouts, "--test-layouts")
    if args.measure is not None:
        if args.output is not None or args.layouts is not None:
            raise UsageError("--measure: trains nothing, so not with -o or --layouts; leave those")
        if (args.data is None) == (not args.test_layouts):
            raise UsageError("--measure: give --test-layouts with layouts, or --data with pictures")
        return
    if args.output is None:
        raise UsageError("train road: give -o OUT.safetensors, or --measure")
    if args.output.suffix != ".safetensors":
        raise UsageError(f"-o {args.output}: expected a name that ends in .safetensors")
    if args.output.exists() and not args.overwrite:
        raise OutputError(f"{args.output}: exists; give another name or --overwrite")
    if (args.data is None) == (args.layouts is None):
        raise UsageError("train road: give --layouts to simulate, or --data with pictures")


def _measure(args: argparse.Namespace) -> int:
    """Measure how well a network does."""
    from crosscue.datasets.adapters.road_folder import load_folder
    from crosscue.detectors.devices import chosen_device
    from crosscue.detectors.networks.road.checkpoint import load_road
    from crosscue.detectors.networks.road.network import embedded_path

    device = chosen_device(args.device, "train road")
    checkpoint = load_road(embedded_path() if args.measure == "embedded" else Path(args.measure))
    size = (checkpoint.facts.width_px, checkpoint.facts.height_px)
    frames = _scored(args, size) if args.data is None else load_folder(args.data, size)
    network = checkpoint.network.to(device)
    _report(args.measure, _measured(network, device, "measured", frames), args)
    return 0


def _report(name: str, facts: dict[str, str | int | float], args: argparse.Namespace) -> None:
    if args.json:
        print_json({"checkpoint": name, **facts})
    elif not args.quiet:
        print("\n".join([name, *(f"  {k:22} {v}" for k, v in facts.items())]))


def _state(args: argparse.Namespace) -> Path:
    output: Path = args.output
    return output.with_suffix(".state")


def _trained(training: RoadTraining, learn: RoadFrames, args: argparse.Namespace) -> float:
    """Train, keeping the state for ``--resume``; the last loss."""
    state, made, loss = _state(args), _made_of(args), float("nan")
    if args.resume and state.exists():
        training.resume(state, made)
    steps = training.steps(learn.pixels, learn.road)

    def at() -> Done:
        return Done(training.done, args.steps, "steps")

    for done, now in with_progress(steps, at, args, "training"):
        loss = now
        if done % SAVED_EVERY == 0:
            training.save(state, made)
        if done == args.stop_at:
            break
    return loss


def _made_of(args: argparse.Namespace) -> dict[str, Any]:
    """Pictures, weights to begin with, and settings: what decides the training."""
    names = ("layouts", "val_layouts", "per_layout", "steps", "batch", "seed", "width")
    return made_of(
        [path for path in (args.data, args.init) if path is not None],
        {name: getattr(args, name) for name in names},
    )


def _measured(
    network: RoadNetwork, device: torch.device, name: str, frames: RoadFrames | None
) -> dict[str, str | int | float]:
    """How well the network does on frames it has not seen."""
    if frames is None:
        return {}
    from crosscue.detectors.training.road import road_score

    score = road_score(network, frames.pixels, frames.road, device)
    return {
        f"{name}_iou": round(score.iou, 4),
        f"{name}_precision": round(score.precision, 4),
        f"{name}_recall": round(score.recall, 4),
        f"{name}_pictures": score.pictures,
    }


def _frames(args: argparse.Namespace) -> tuple[RoadFrames, RoadFrames | None]:
    """What to learn from and what to hold out."""
    size = _size(args)
    if args.data is not None:
        from crosscue.datasets.adapters.road_folder import load_folder

        whole = load_folder(args.data, size)
        kept = [i for i in range(len(whole)) if i % HELD_EVERY or len(whole) < HELD_EVERY]
        out = [i for i in range(len(whole)) if i not in set(kept)]
        held = RoadFrames(whole.pixels[out], whole.road[out]) if out else None
        return RoadFrames(whole.pixels[kept], whole.road[kept]), held
    layouts = learnt_layouts_of(args.layouts, "--layouts")
    held_out = layouts_of(args.val_layouts, "--val-layouts")
    if both := sorted({*layouts} & {*held_out}):
        raise UsageError(f"--val-layouts {both[0]}: also trained on; hold out others")
    learn = _rendered(layouts, size, args)
    return learn, _rendered(held_out, size, args) if held_out else None


def _size(args: argparse.Namespace) -> Size:
    return (args.width, args.width * 9 // 16)


def _scored(args: argparse.Namespace, size: Size) -> RoadFrames | None:
    names = layouts_of(args.test_layouts, "--test-layouts")
    return _rendered(names, size, args) if names else None


def _rendered(names: list[str], size: Size, args: argparse.Namespace) -> RoadFrames:
    camera = Camera(width_px=2 * size[0], height_px=2 * size[1])
    # Conditions come in ten kinds; each comes as often.
    runs = [
        SceneSettings(layout=name, run=number % 10 + 1, seed=args.seed, camera=camera)
        for number, name in enumerate(names)
    ]
    if len(names) <= len(SCORED) and {*names} <= {*SCORED}:
        runs = [
            SceneSettings(layout=name, run=run, seed=args.seed, camera=camera)
            for name in names
            for run in range(1, 11)
        ]
    parts: list[RoadFrames] = []
    made: Iterator[RoadFrames] = rendered(runs, args.per_layout, size)
    for part in with_progress(made, lambda: Done(len(parts), len(runs), "runs"), args, "rendering"):
        parts.append(part)
    return joined(parts)
