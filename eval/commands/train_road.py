"""Train the road network, on simulated intersections or on pictures with masks of one's own.

Simulated: renders --each pictures of each layout of --layouts (L and a number), and measures on
layouts it has not seen, --held. A to H may only be --score-d, never trained on. One's own: a folder
--data with images/NAME.jpg and masks/NAME.png, white where road is; every tenth is held out.

examples:
  crosscue train road --layouts L400-L519 --held L600-L611 --score A-H -o road.safetensors
  crosscue train road --data my_frames --from road.safetensors -o mine.safetensors
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.datasets.scenes.camera import Camera
from crosscue.datasets.scenes.drive import SceneSettings
from crosscue.datasets.scenes.layout import SCORED
from crosscue.datasets.scenes.road_frames import RoadFrames, joined, rendered
from crosscue.replay.errors import OutputError, UsageError

from .common import print_json, with_progress

if TYPE_CHECKING:
    from crosscue.detectors.road_training import RoadTraining

HELD_EVERY = 10
SAVED_EVERY = 100


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("--layouts", nargs="+", metavar="LAYOUT", help="L400 or a span: L400-L519")
    parser.add_argument("--held", nargs="+", metavar="LAYOUT", default=[],
                        help="layouts to measure on, none of them trained on")  # fmt: skip
    parser.add_argument("--score", nargs="+", metavar="LAYOUT", default=[],
                        help="further layouts to measure on at the end: A-H")  # fmt: skip
    parser.add_argument("--data", type=Path, metavar="DIR", help="images/ and masks/ of one's own")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.safetensors")
    parser.add_argument("--from", dest="start", type=Path, metavar="FILE",
                        help="begin with these weights")  # fmt: skip
    parser.add_argument("--resume", action="store_true",
                        help="go on after an interruption, from OUT.state")  # fmt: skip
    parser.add_argument("--each", type=int, default=12, help="pictures of each layout")
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--stop-at", type=int, metavar="N",
                        help="end after so many of the schedule's steps")  # fmt: skip
    parser.add_argument("--batch", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--width", type=int, default=384, help="of the network's input (9/16 high)")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda", "mps"), default="auto")
    parser.add_argument("--threads", type=int, default=0, help="on a CPU; 0 for as many as it has")
    parser.add_argument("--overwrite", action="store_true", help="replace OUT")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Render or read, train, measure, write."""
    if args.output.suffix != ".safetensors":
        raise UsageError(f"-o {args.output}: want a name that ends in .safetensors")
    if args.output.exists() and not args.overwrite:
        raise OutputError(f"{args.output}: exists; give another name or --overwrite")
    if args.width % 16 or not 128 <= args.width <= 1024:
        raise UsageError(f"--width {args.width}: want a multiple of 16 from 128 to 1024")
    if min(args.each, args.steps, args.batch, args.stop_at or 1) < 1:
        raise UsageError("--each, --steps, --stop-at, --batch: want 1 or more")
    import torch

    from crosscue.detectors.road_checkpoint import RoadFacts, load_road, save_road
    from crosscue.detectors.road_network import device_of
    from crosscue.detectors.road_training import RoadSchedule, RoadTraining

    if args.threads:
        torch.set_num_threads(args.threads)
    learn, held = _frames(args)
    schedule = RoadSchedule(args.steps, args.batch, seed=args.seed)
    training = RoadTraining(schedule, device_of(args.device))
    if args.start is not None:
        training.network.load_state_dict(load_road(args.start).network.state_dict())
    loss = _trained(training, learn, args)
    recipe: dict[str, str | int | float] = {
        "layouts": " ".join(args.layouts or []), "pictures": len(learn), "steps": args.steps,
        "stopped_at": training.done, "batch": args.batch, "seed": args.seed, "loss": round(loss, 5),
        **_measured(training, "held_out", held),
        **_measured(training, "scored", _scored(args)),
    }  # fmt: skip
    facts = RoadFacts(width_px=args.width, height_px=args.width * 9 // 16, recipe=recipe)
    save_road(args.output, training.network, facts)
    _state(args).unlink(missing_ok=True)
    if args.json:
        print_json({"checkpoint": str(args.output), **recipe})
    elif not args.quiet:
        print("\n".join([str(args.output), *(f"  {k:22} {v}" for k, v in recipe.items())]))
    return 0


def _state(args: argparse.Namespace) -> Path:
    output: Path = args.output
    return output.with_suffix(".state")


def _trained(training: RoadTraining, learn: RoadFrames, args: argparse.Namespace) -> float:
    """Train, keeping the state for ``--resume``; the last loss."""
    state, loss = _state(args), float("nan")
    if args.resume and state.exists():
        training.resume(state)
    steps = training.steps(learn.pixels, learn.road)
    for done, now in with_progress(steps, lambda: training.done / args.steps, args, "training"):
        loss = now
        if done % SAVED_EVERY == 0:
            training.save(state)
        if done == args.stop_at:
            break
    return loss


def _measured(
    training: RoadTraining, name: str, frames: RoadFrames | None
) -> dict[str, str | int | float]:
    """How well the network does on frames it has not seen."""
    if frames is None:
        return {}
    from crosscue.detectors.road_training import road_score

    score = road_score(training.network, frames.pixels, frames.road, training.device)
    return {
        f"{name}_iou": round(score.iou, 4),
        f"{name}_precision": round(score.precision, 4),
        f"{name}_recall": round(score.recall, 4),
        f"{name}_pictures": score.pictures,
    }


def _frames(args: argparse.Namespace) -> tuple[RoadFrames, RoadFrames | None]:
    """What to learn from and what to hold out."""
    size = (args.width, args.width * 9 // 16)
    if (args.data is None) == (args.layouts is None):
        raise UsageError("train road: give --layouts to simulate, or --data with pictures")
    if args.data is not None:
        from crosscue.datasets.road_folder import load_folder

        whole = load_folder(args.data, size)
        kept = [i for i in range(len(whole)) if i % HELD_EVERY or len(whole) < HELD_EVERY]
        out = [i for i in range(len(whole)) if i not in set(kept)]
        held = RoadFrames(whole.pixels[out], whole.road[out]) if out else None
        return RoadFrames(whole.pixels[kept], whole.road[kept]), held
    layouts, held_out = _names(args.layouts), _names(args.held)
    if both := sorted({*layouts} & {*held_out}):
        raise UsageError(f"--held {both[0]}: also trained on; hold out others")
    if scored := sorted({*layouts} & {*SCORED}):
        raise UsageError(f"--layouts {scored[0]}: A to H are only for scoring; take L and a number")
    learn = _rendered(layouts, args, "rendering")
    return learn, _rendered(held_out, args, "rendering") if held_out else None


def _scored(args: argparse.Namespace) -> RoadFrames | None:
    names = _names(args.score)
    return _rendered(names, args, "rendering") if names else None


def _rendered(names: list[str], args: argparse.Namespace, what: str) -> RoadFrames:
    size = (args.width, args.width * 9 // 16)
    camera = Camera(width_px=2 * args.width, height_px=2 * size[1])
    # Conditions come in ten kinds; each comes as often.
    runs = [
        SceneSettings(layout=name, run=number % 10 + 1, seed=args.seed, camera=camera)
        for number, name in enumerate(names)
    ]
    if len(names) <= len(SCORED) and {*names} <= {*SCORED}:
        runs = [
            SceneSettings(layout=name, run=run, seed=args.seed, camera=camera)
            for name in names for run in range(1, 11)
        ]  # fmt: skip
    parts: list[RoadFrames] = []
    made: Iterator[RoadFrames] = rendered(runs, args.each, size)
    for part in with_progress(made, lambda: len(parts) / len(runs), args, what):
        parts.append(part)
    return joined(parts)


def _names(texts: list[str]) -> list[str]:
    """Layouts of names and spans: ``L0-L9``, ``A-H``.

    Raises:
        UsageError: One is none.
    """
    names: list[str] = []
    for text in texts:
        span = re.fullmatch(r"L(\d{1,9})(?:-L(\d{1,9}))?", text)
        letters = re.fullmatch(r"([A-H])(?:-([A-H]))?", text)
        if span is not None:
            first, last = int(span[1]), int(span[2] or span[1])
            names += [f"L{k}" for k in range(first, last + 1)]
        elif letters is not None:
            first, last = SCORED.index(letters[1]), SCORED.index(letters[2] or letters[1])
            names += list(SCORED[first : last + 1])
        else:
            raise UsageError(f"train road: {text!r} is no layout; want L0, L0-L99, A or A-H")
    return names
