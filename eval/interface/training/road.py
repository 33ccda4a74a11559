"""Train and measure road networks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from crosscue.datasets.scenes.export.road_frames import RoadFrames, joined, rendered
from crosscue.datasets.scenes.layout import SCORED
from crosscue.datasets.scenes.rendering.camera import Camera
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.eval.interface.training.inputs import check_place, layouts_of, training_layouts_of
from crosscue.replay.errors import OutputError, UsageError
from crosscue.replay.files.made_of import made_of

if TYPE_CHECKING:
    import torch

    from crosscue.detectors.networks.road.network import RoadNetwork
    from crosscue.detectors.training.road import RoadTraining

Size: TypeAlias = tuple[int, int]
"""Width and height, pixels."""
Reported: TypeAlias = dict[str, str | int | float]
OnCount: TypeAlias = Callable[[int, int], None]
HELD_EVERY: Final = 10
SAVED_EVERY: Final = 100


def _ignore(done: int, of: int) -> None:
    """Ignore progress."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadTrainingSettings:
    """Settings of a road network's training.

    Set either ``layouts`` to simulate, or ``data`` with pictures.

    Attributes:
        layouts: Simulated layouts to train on, names and ranges: L400, L400-L519. A to H are
            allowed only as ``test_layouts``.
        val_layouts: Layouts to validate on, different from ``layouts``.
        test_layouts: Layouts to measure on at the end.
        data: Folder with ``images/NAME.jpg`` and ``masks/NAME.png``, white where there is road;
            every tenth picture is held out.
        init: Checkpoint with the initial weights; default: random weights.
        per_layout: Number of pictures of each layout.
        steps: Number of training steps.
        stop_at: Stop after this many steps of the schedule.
        batch: Pictures per step.
        seed: Seed of all random numbers.
        width_px: Width of the network's input, a multiple of 16; the height is 9/16 of it.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        threads: CPU threads; 0 for all.
    """

    layouts: Sequence[str] = ()
    val_layouts: Sequence[str] = ()
    test_layouts: Sequence[str] = ()
    data: Path | str | None = None
    init: Path | str | None = None
    per_layout: int = 12
    steps: int = 1500
    stop_at: int | None = None
    batch: int = 12
    seed: int = 0
    width_px: int = 384
    device: str = "auto"
    threads: int = 0

    @property
    def size_px(self) -> Size:
        """Width and height of the network's input."""
        return (self.width_px, self.width_px * 9 // 16)


@dataclass(frozen=True, slots=True, repr=False)
class TrainedRoad:
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

    def __repr__(self) -> str:
        return "\n".join(
            [self.checkpoint, *(f"  {name:22} {value}" for name, value in self.facts.items())]
        )


def train_road(
    settings: RoadTrainingSettings,
    output: Path | str,
    *,
    resume: bool = False,
    overwrite: bool = False,
    on_runs: OnCount = _ignore,
    on_steps: OnCount = _ignore,
) -> TrainedRoad:
    """Train a road network on simulated intersections, or on pictures with masks.

    The same settings and seed yield the same bytes on the same machine's CPU.

    Args:
        settings: Data and schedule of the training.
        output: Checkpoint to write, ``.safetensors``. Until the training ends, its state is stored
            next to it, with the suffix ``.state``.
        resume: Continue an interrupted training from its state.
        overwrite: Replace an existing checkpoint.
        on_runs: Called with the number of simulated runs rendered, and their total.
        on_steps: Called with the number of steps done, and their total.

    Raises:
        UsageError: A value is out of range, a layout to train on is one of A to H, a layout is
            named twice, or the state is of another training.
        OutputError: The checkpoint exists, or cannot be written.
        LogError: A picture or its mask is missing or cannot be decoded.
        SchemaError: The state is damaged.
        VehicleError: ``init`` is not a road network, or the device is missing.
    """
    path = Path(output)
    _check(settings)
    if path.suffix != ".safetensors":
        raise UsageError(f"-o {path}: expected a name that ends in .safetensors")
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: exists; give another name or --overwrite")
    if (settings.data is None) == (not settings.layouts):
        raise UsageError("train road: expected --layouts to simulate, or --data with pictures")
    import torch

    from crosscue.detectors.networks.devices import chosen_device
    from crosscue.detectors.networks.road.checkpoint import RoadFacts, load_road, save_road
    from crosscue.detectors.training.reproducible import decides_bits, reproducible
    from crosscue.detectors.training.road import RoadSchedule, RoadTraining

    if settings.threads:
        torch.set_num_threads(settings.threads)
    check_place(path)
    learn, held_out = _frames(settings, on_runs)
    schedule = RoadSchedule(settings.steps, settings.batch, seed=settings.seed)
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
        loss = _trained(training, learn, settings, state, made, on_steps)
    scored = _test_frames(settings, settings.size_px, on_runs)
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


def measure_road(
    network: Path | str,
    *,
    test_layouts: Sequence[str] = (),
    data: Path | str | None = None,
    per_layout: int = 12,
    seed: int = 0,
    device: str = "auto",
    on_runs: OnCount = _ignore,
) -> TrainedRoad:
    """Measure the accuracy of a road network, without training it.

    Set either ``test_layouts`` or ``data``.

    Args:
        network: ``embedded``, or a checkpoint.
        test_layouts: Simulated layouts to measure on, names and ranges.
        data: Folder with ``images`` and ``masks``, as in ``RoadTrainingSettings``.
        per_layout: Number of pictures of each layout.
        seed: Seed of everything that differs between runs.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        on_runs: Called with the number of simulated runs rendered, and their total.

    Raises:
        UsageError: A value is out of range, or both or neither of ``test_layouts`` and ``data`` are
            set.
        LogError: A picture or its mask is missing or cannot be decoded.
        VehicleError: The network is not a road network, or the device is missing.
    """
    settings = RoadTrainingSettings(
        test_layouts=test_layouts, data=data, per_layout=per_layout, seed=seed, device=device
    )
    _check(settings)
    if (data is None) == (not test_layouts):
        raise UsageError("--measure: expected --test-layouts with layouts, or --data with pictures")
    from crosscue.datasets.adapters.road_folder import load_folder
    from crosscue.detectors.networks.devices import chosen_device
    from crosscue.detectors.networks.road.checkpoint import load_road
    from crosscue.detectors.networks.road.network import embedded_path

    chosen = chosen_device(device, "train road")
    checkpoint = load_road(embedded_path() if str(network) == "embedded" else Path(network))
    size = (checkpoint.facts.width_px, checkpoint.facts.height_px)
    frames = (
        _test_frames(settings, size, on_runs) if data is None else load_folder(Path(data), size)
    )
    measured = _measured(checkpoint.network.to(chosen), chosen, "measured", frames)
    return TrainedRoad(str(network), measured)


def _check(settings: RoadTrainingSettings) -> None:
    width_px = settings.width_px
    if width_px % 16 or not 128 <= width_px <= 1024:
        raise UsageError(f"--width {width_px}: expected a multiple of 16 from 128 to 1024")
    stop_at = 1 if settings.stop_at is None else settings.stop_at
    if min(settings.per_layout, settings.steps, settings.batch, stop_at) < 1:
        raise UsageError("--per-layout, --steps, --stop-at, --batch: expected 1 or more")
    if min(settings.seed, settings.threads) < 0:
        raise UsageError("--seed, --threads: expected 0 or more")
    layouts_of(settings.test_layouts, "--test-layouts")


def _trained(
    training: RoadTraining,
    learn: RoadFrames,
    settings: RoadTrainingSettings,
    state: Path,
    made: dict[str, Any],
    on_steps: OnCount,
) -> float:
    """Train, save the state to resume from at intervals, and return the last loss."""
    loss = float("nan")
    for done, now in training.steps(learn.pixels, learn.road):
        loss = now
        on_steps(done, settings.steps)
        if done % SAVED_EVERY == 0:
            training.save(state, made)
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


def _frames(
    settings: RoadTrainingSettings, on_runs: OnCount
) -> tuple[RoadFrames, RoadFrames | None]:
    """Return the frames to train on, and the held-out frames."""
    size = settings.size_px
    if settings.data is not None:
        from crosscue.datasets.adapters.road_folder import load_folder

        whole = load_folder(Path(settings.data), size)
        kept = [i for i in range(len(whole)) if i % HELD_EVERY or len(whole) < HELD_EVERY]
        out = [i for i in range(len(whole)) if i not in set(kept)]
        held = RoadFrames(whole.pixels[out], whole.road[out]) if out else None
        return RoadFrames(whole.pixels[kept], whole.road[kept]), held
    layouts = training_layouts_of(settings.layouts, "--layouts")
    held_out = layouts_of(settings.val_layouts, "--val-layouts")
    if both := sorted({*layouts} & {*held_out}):
        raise UsageError(f"--val-layouts {both[0]}: also in --layouts; choose other layouts")
    learn = _rendered(layouts, size, settings, on_runs)
    return learn, _rendered(held_out, size, settings, on_runs) if held_out else None


def _test_frames(settings: RoadTrainingSettings, size: Size, on_runs: OnCount) -> RoadFrames | None:
    names = layouts_of(settings.test_layouts, "--test-layouts")
    return _rendered(names, size, settings, on_runs) if names else None


def _rendered(
    names: list[str], size: Size, settings: RoadTrainingSettings, on_runs: OnCount
) -> RoadFrames:
    camera, seed = Camera(width_px=2 * size[0], height_px=2 * size[1]), settings.seed
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
    for part in rendered(runs, settings.per_layout, size):
        parts.append(part)
        on_runs(len(parts), len(runs))
    return joined(parts)
