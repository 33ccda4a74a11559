"""Train and measure road networks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeAlias

from crosscue.datasets.scenes.layout import SCORED
from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.datasets.scenes.single_frames import (
    RoadFrames,
    concatenate_frames,
    load_folder,
    render_road_frames,
)
from crosscue.eval.training.inputs import Device, check_place, layouts_of, training_layouts_of
from crosscue.replay.errors import OutputError, UsageError
from crosscue.replay.files.made_of import made_of
from crosscue.replay.progress import Progress, emit
from crosscue.results import Result
from crosscue.verb import Option

if TYPE_CHECKING:
    import torch

    from crosscue.detectors.networks.road.network import RoadNetwork
    from crosscue.detectors.training.road import RoadTraining

# Width and height, pixels.
Size: TypeAlias = tuple[int, int]
Reported: TypeAlias = dict[str, str | int | float]
Layouts: TypeAlias = Annotated[Sequence[str], Option(metavar="LAYOUT")]
HELD_EVERY: Final = 10
SAVED_EVERY: Final = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadTrainingSettings:
    """Settings of a road network's training.

    Set either ``layouts`` to simulate, or ``data`` with pictures.

    Attributes:
        layouts: Layouts to train on: L400 or a range, L400-L519.
        val_layouts: Layouts to validate on, different from --layouts.
        test_layouts: Layouts to measure on at the end, such as A-H.
        data: Folder with your own images/ and masks/.
        init: Initial weights.
        per_layout: Images per layout.
        steps: Training steps.
        stop_at: Stop after N steps of the schedule.
        batch: Images per batch.
        seed: Random seed.
        width_px: Input width in pixels; height is 9/16.
        device: Device to train on.
        threads: CPU threads; 0 for all.
    """

    layouts: Layouts = ()
    val_layouts: Layouts = ()
    test_layouts: Layouts = ()
    data: Annotated[Path | str | None, Option(metavar="DIR")] = None
    init: Path | str | None = None
    per_layout: int = 12
    steps: int = 1500
    stop_at: int | None = None
    batch: int = 12
    seed: int = 0
    width_px: Annotated[int, Option("--width")] = 384
    device: Device = "auto"
    threads: int = 0

    @property
    def size_px(self) -> Size:
        """Width and height of the network's input."""
        return (self.width_px, self.width_px * 9 // 16)


@dataclass(frozen=True, slots=True, repr=False)
class TrainedRoad(Result):
    """A trained or measured road network; its repr is its name and one line per fact.

    Attributes:
        checkpoint: Checkpoint file, or ``embedded``.
        facts: After a training, the checkpoint's recipe with measurements; after a measurement,
            intersection over union, precision, recall, and number of pictures.
    """

    checkpoint: str
    facts: Reported

    def as_dict(self) -> Reported:
        """Return the JSON output of ``crosscue train road``."""
        return {"checkpoint": self.checkpoint, **self.facts}

    def lines(self) -> Iterator[str]:
        """Yield the checkpoint, and a line for each fact."""
        yield self.checkpoint
        yield from (f"  {name:22} {value}" for name, value in self.facts.items())


def train_road(
    settings: RoadTrainingSettings,
    output: Annotated[Path | str | None, Option(metavar="OUT.safetensors")] = None,
    *,
    measure: Annotated[str | Path | None, Option(metavar="NETWORK")] = None,
    resume: bool = False,
    overwrite: bool = False,
) -> TrainedRoad:
    r"""Train the road network on simulated images, or on your own with masks.

    Simulated images: --per-layout images of each of --layouts (L0, L1, and so on) are rendered to
    train on, and other layouts, --val-layouts, to validate on. Layouts A to H are allowed only as
    --test-layouts. Your own images: --data is a folder with images/NAME.jpg and masks/NAME.png,
    white where there is road; every tenth image is held out. --measure measures a network on
    --test-layouts or --data, without training. The same settings and seed yield the same bytes on
    the same machine's CPU.

    Examples:
        crosscue train road --layouts L400-L519 --val-layouts L600-L611 \
            --test-layouts A-H -o road.safetensors
        crosscue train road --data my_frames --init road.safetensors -o mine.safetensors
        crosscue train road --measure embedded --test-layouts A-H

    Args:
        settings: Data and schedule of the training.
        output: Checkpoint to write.
        measure: Measure this network instead of training: embedded, or a file.
        resume: Continue an interrupted training from OUT.state.
        overwrite: Replace an existing OUT.

    Raises:
        UsageError: A value is out of range, a layout to train on is one of A to H, a layout is
            named twice, or the state is of another training.
        OutputError: The checkpoint exists, or cannot be written.
        LogError: A picture or its mask is missing or cannot be decoded.
        SchemaError: The state is damaged.
        VehicleError: ``init`` is not a road network, or the device is missing.
    """
    if measure is not None:
        if output is not None or settings.layouts:
            raise UsageError(
                "measure: cannot be combined with -o or --layouts, because nothing is trained"
            )
        return _measure(str(measure), settings)
    if output is None:
        raise UsageError("train road: expected -o OUT.safetensors, or --measure")
    _check(settings)
    path = Path(output)
    if path.suffix != ".safetensors":
        raise UsageError(f"output: {path}, expected a name that ends in .safetensors")
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: exists; give another name or --overwrite")
    if (settings.data is None) == (not settings.layouts):
        raise UsageError("train road: expected --layouts to simulate, or --data with pictures")
    import torch

    from crosscue.detectors.networks.devices import chosen_device
    from crosscue.detectors.networks.road.checkpoint import RoadFacts, load_road, save_road
    from crosscue.detectors.training.loop import decides_bits, reproducible
    from crosscue.detectors.training.road import RoadSchedule, RoadTraining

    if settings.threads:
        torch.set_num_threads(settings.threads)
    check_place(path)
    learn, held_out = _frames(settings)
    schedule = RoadSchedule(settings.steps, batch=settings.batch, seed=settings.seed)
    device = chosen_device(settings.device, "train road")
    state = path.with_suffix(".state")
    with reproducible(device):
        training = RoadTraining(schedule, device)
        if settings.init is not None:
            begun = load_road(Path(settings.init)).network
            training.network.load_state_dict(begun.state_dict())
        made = _made_of(settings)
        if resume and state.exists():
            training.resume(state, made)
        loss = _trained(training, learn, settings, state, made)
    scored = _test_frames(settings, settings.size_px)
    recipe: Reported = {
        "layouts": " ".join(settings.layouts),
        "pictures": len(learn),
        "steps": settings.steps,
        "stopped_at": training.done,
        "batch": settings.batch,
        "seed": settings.seed,
        "loss": round(loss, 5),
        **_measured(training.network, training.device, "held_out", held_out),
        **_measured(training.network, training.device, "scored", scored),
        **decides_bits(device),
    }
    width_px, height_px = settings.size_px
    save_road(
        path, training.network, RoadFacts(width_px=width_px, height_px=height_px, recipe=recipe)
    )
    state.unlink(missing_ok=True)
    return TrainedRoad(str(path), recipe)


def _measure(network: str, settings: RoadTrainingSettings) -> TrainedRoad:
    """Measure the accuracy of a network on ``test_layouts`` or ``data``, without training it."""
    _check(settings)
    if (settings.data is None) == (not settings.test_layouts):
        raise UsageError("measure: expected --test-layouts with layouts, or --data with pictures")
    from crosscue.detectors.networks.devices import chosen_device
    from crosscue.detectors.networks.road.checkpoint import load_road
    from crosscue.detectors.networks.road.network import embedded_road

    chosen = chosen_device(settings.device, "train road")
    checkpoint = load_road(embedded_road() if network == "embedded" else Path(network))
    size = (checkpoint.facts.width_px, checkpoint.facts.height_px)
    if settings.data is None:
        frames = _test_frames(settings, size)
    else:
        frames = load_folder(Path(settings.data), size)
    measured = _measured(checkpoint.network.to(chosen), chosen, "measured", frames)
    return TrainedRoad(network, measured)


def _check(settings: RoadTrainingSettings) -> None:
    width_px = settings.width_px
    if width_px % 16 or not 128 <= width_px <= 1024:
        raise UsageError(f"width_px: {width_px}, expected a multiple of 16 from 128 to 1024")
    stop_at = 1 if settings.stop_at is None else settings.stop_at
    if min(settings.per_layout, settings.steps, settings.batch, stop_at) < 1:
        raise UsageError("per_layout, steps, stop_at, batch: expected 1 or more")
    if min(settings.seed, settings.threads) < 0:
        raise UsageError("seed, threads: expected 0 or more")
    layouts_of(settings.test_layouts, "test_layouts")


def _trained(
    training: RoadTraining,
    learn: RoadFrames,
    settings: RoadTrainingSettings,
    state: Path,
    made: dict[str, Any],
) -> float:
    """Train, save the state to resume from at intervals, and return the last loss."""
    loss = float("nan")
    for done, now in training.steps(learn.pixels, learn.road):
        loss = now
        emit(Progress("training", done, settings.steps, "steps"))
        if done % SAVED_EVERY == 0:
            training.save(state, made_of=made)
        if done == settings.stop_at:
            break
    return loss


def _made_of(settings: RoadTrainingSettings) -> dict[str, Any]:
    """Return the inputs that determine the training: pictures, initial weights and settings."""
    return made_of(
        [Path(path) for path in (settings.data, settings.init) if path is not None],
        {
            "layouts": settings.layouts or None,
            "val_layouts": settings.val_layouts,
            "per_layout": settings.per_layout,
            "steps": settings.steps,
            "batch": settings.batch,
            "seed": settings.seed,
            "width": settings.width_px,
        },
    )


def _measured(
    network: RoadNetwork, device: torch.device, name: str, frames: RoadFrames | None
) -> Reported:
    """Return the network's accuracy on held-out frames."""
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


def _frames(settings: RoadTrainingSettings) -> tuple[RoadFrames, RoadFrames | None]:
    """Return the frames to train on, and the held-out frames."""
    size = settings.size_px
    if settings.data is not None:
        from crosscue.datasets.scenes.single_frames import load_folder

        whole = load_folder(Path(settings.data), size)
        kept = [i for i in range(len(whole)) if i % HELD_EVERY or len(whole) < HELD_EVERY]
        out = [i for i in range(len(whole)) if i not in set(kept)]
        held = RoadFrames(whole.pixels[out], whole.road[out]) if out else None
        return RoadFrames(whole.pixels[kept], whole.road[kept]), held
    layouts = training_layouts_of(settings.layouts, "layouts")
    held_out = layouts_of(settings.val_layouts, "val_layouts")
    if both := sorted({*layouts} & {*held_out}):
        raise UsageError(f"val_layouts: {both[0]}: also in --layouts; choose other layouts")
    learn = _rendered(layouts, size, settings)
    return learn, _rendered(held_out, size, settings) if held_out else None


def _test_frames(settings: RoadTrainingSettings, size: Size) -> RoadFrames | None:
    names = layouts_of(settings.test_layouts, "test_layouts")
    return _rendered(names, size, settings) if names else None


def _rendered(names: list[str], size: Size, settings: RoadTrainingSettings) -> RoadFrames:
    camera, seed = SceneCamera(width_px=2 * size[0], height_px=2 * size[1]), settings.seed
    # There are ten kinds of conditions, by number of the run; this uses each equally often.
    runs = [
        SceneSettings(layout=name, run=number % 10 + 1, seed=seed, camera=camera)
        for number, name in enumerate(names)
    ]
    if len(names) <= len(SCORED) and {*names} <= {*SCORED}:
        runs = [
            SceneSettings(layout=name, run=run, seed=seed, camera=camera)
            for name in names
            for run in range(1, 11)
        ]
    parts: list[RoadFrames] = []
    for run in runs:
        parts.append(render_road_frames(run, settings.per_layout, size))
        emit(Progress("rendering", len(parts), len(runs), "runs"))
    return concatenate_frames(parts)
