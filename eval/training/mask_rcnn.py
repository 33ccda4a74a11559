"""Train and measure Mask R-CNN networks."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal, overload

from crosscue.detectors.training.summary import draw_curve, measured_text, measured_tree
from crosscue.eval.training.inputs import Device, check_place
from crosscue.replay.errors import UsageError
from crosscue.replay.files.made_of import made_of
from crosscue.replay.progress import Progress, emit
from crosscue.replay.safe_text import counted
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option

if TYPE_CHECKING:
    from crosscue.detectors.networks.mask_rcnn.checkpoint import Facts
    from crosscue.detectors.training.annotations import LabelledSet
    from crosscue.detectors.training.job import CurvePoint, TrainingJob
    from crosscue.detectors.training.measure import NetworkResults

CLASSES: Final = ("car", "stop sign", "traffic light")
HELD_EVERY: Final = 10
# Number of region proposals that the detector uses.
PROPOSALS: Final = 100
# Max side length of a training window.
MAX_WINDOW_PX: Final = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class MaskRcnnTrainingSettings:
    """Settings of a Mask R-CNN training.

    Attributes:
        data: Annotations to train on.
        images: Folder of their images.
        val_data: Annotations to validate on (default: every 10th image of --data).
        val_images: Folder of their images.
        init: Initial weights: compact, resnet50, resnet50-v2, embedded, or a file.
        classes: Classes to train (default: car, stop sign, traffic light).
        steps: Training steps.
        batch: Images per batch.
        learning_rate: Max learning rate.
        seed: Random seed.
        width_px: Width that images are scaled to.
        crop_top: Top fraction of the image to skip.
        crop_bottom: Bottom fraction of the image to skip.
        window_px: Width and height of the training windows, in pixels.
        balance: 0 samples every object equally often, 1 every class.
        check_every: Steps between validations.
        check_images: Images per validation during training.
        device: Device to train on.
        threads: CPU threads.
    """

    data: Annotated[Path | str, Option(metavar="COCO")]
    images: Annotated[Path | str, Option(metavar="DIR")]
    val_data: Annotated[Path | str | None, Option(metavar="COCO")] = None
    val_images: Annotated[Path | str | None, Option(metavar="DIR")] = None
    init: Annotated[str | Path, Option(metavar="NETWORK")] = "compact"
    classes: Sequence[str] = CLASSES
    steps: int = 4000
    batch: int = 8
    learning_rate: Annotated[float, Option(metavar="R")] = 1e-3
    seed: int = 0
    width_px: Annotated[int, Option("--width")] = 1280
    crop_top: Annotated[float, Option(metavar="FRACTION")] = 0.0
    crop_bottom: Annotated[float, Option(metavar="FRACTION")] = 0.0
    window_px: Annotated[tuple[int, int], Option("--window", metavar=("W", "H"))] = (544, 288)
    balance: Annotated[float, Option(metavar="FRACTION")] = 1.0
    check_every: int = 500
    check_images: int = 60
    device: Device = "auto"
    threads: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Measuring:
    """Measurement of a Mask R-CNN in place of a training.

    Attributes:
        measure: Measure this network instead of training; names as for --init.
        subset: Measure on these images of --data: ::4 is every 4th.
        proposals: Measure with N region proposals; may have several values.
        backend: Inference engine to measure with.
    """

    measure: Annotated[str | None, Option(metavar="NETWORK")] = None
    subset: Annotated[str | None, Option(metavar="A:B:N")] = None
    proposals: Annotated[Sequence[int], Option(metavar="N")] = (PROPOSALS,)
    backend: Literal["torch", "openvino"] = "torch"


@dataclass(frozen=True, slots=True, repr=False)
class TrainedMaskRcnn(Result):
    """A trained Mask R-CNN; its repr is one line.

    Attributes:
        path: The checkpoint.
        facts: Plan, calibration, measured precision and recipe that the checkpoint records.
    """

    path: Path
    facts: Facts

    json_is: ClassVar = "facts"

    def lines(self) -> Iterator[str]:
        """Yield size and accuracy of the checkpoint."""
        size = self.path.stat().st_size / 1e6
        yield f"{self.path}: {size:.1f} MB, {_precision_text(self.facts.measured)}"


@dataclass(frozen=True, slots=True, repr=False)
class MeasuredMaskRcnn(Result):
    """Accuracy of a Mask R-CNN on labelled images; its repr is tables.

    Attributes:
        network: Name of the network.
        pictures: Number of pictures it was measured on.
        by_proposals: Average precisions, and rates at the cues' scores, by number of proposals.
    """

    network: str
    pictures: int
    by_proposals: dict[int, NetworkResults] = field(metadata=HIDDEN)
    also: ClassVar = {"measured": "measured"}

    @property
    def measured(self) -> list[dict[str, Any]]:
        """What was measured with each number of proposals."""
        return [measured_tree(count, reached) for count, reached in self.by_proposals.items()]

    def lines(self) -> Iterator[str]:
        """Yield a table for each number of proposals."""
        for count, reached in self.by_proposals.items():
            yield measured_text(self.network, self.pictures, count, reached)


@overload
def train_mask_rcnn(
    settings: MaskRcnnTrainingSettings,
    output: Path | str,
    *,
    resume: bool = False,
    overwrite: bool = False,
) -> TrainedMaskRcnn: ...
@overload
def train_mask_rcnn(
    settings: MaskRcnnTrainingSettings, output: None = None, *, measuring: Measuring
) -> MeasuredMaskRcnn: ...
def train_mask_rcnn(
    settings: MaskRcnnTrainingSettings,
    output: Annotated[Path | str | None, Option(metavar="OUT.safetensors")] = None,
    *,
    measuring: Measuring = Measuring(),
    resume: bool = False,
    overwrite: bool = False,
) -> TrainedMaskRcnn | MeasuredMaskRcnn:
    r"""Train a Mask R-CNN on COCO annotations, from scratch or from a network.

    OUT is a checkpoint (.safetensors) for the detector mask-rcnn. The training curve (JSON and PNG)
    is written next to it and, until the training ends, so is the state that --resume continues
    from. The same settings and seed yield the same bytes on the same machine's CPU. With --measure,
    nothing is trained: a network's average precision (by COCO's rules), and its precision and
    recall at the cues' thresholds are reported.

    Examples:
        crosscue train frames L0-L319 --per-layout 8 -o frames
        crosscue train frames L900-L959 --per-layout 5 -o held_out
        crosscue train mask-rcnn --data frames/coco.json --images frames/images \
            --val-data held_out/coco.json --val-images held_out/images -o mine.safetensors
        crosscue train mask-rcnn --data own.json --images photos --init resnet50 -o own.safetensors
        crosscue train mask-rcnn --measure embedded --data held_out/coco.json \
            --images held_out/images

    Args:
        settings: Data and schedule of the training.
        output: Checkpoint to write.
        measuring: The network to measure instead of training.
        resume: Continue an interrupted training.
        overwrite: Replace existing results.

    Raises:
        UsageError: A value is out of range, the subset has no images, or the state is of another
            training.
        OutputError: Results exist, or cannot be written.
        LogError: An image cannot be read.
        SchemaError: The annotations are not a COCO file or contain nothing usable, the folder of
            images is missing, or the state is damaged.
        VehicleError: ``init`` is not a suitable Mask R-CNN, or the device is missing.
        CrosscueError: The loss is no longer finite.
    """
    if measuring.measure is not None:
        if output is not None or settings.val_data is not None:
            raise UsageError(
                "measure: cannot be combined with -o or --val-data, because nothing is trained"
            )
        return _measure(measuring.measure, measuring, settings)
    if output is None:
        raise UsageError("train mask-rcnn: expected -o OUT.safetensors, or --measure")
    path = Path(output)
    _check(settings, path)
    job = _job(settings, path)
    check_place(path)
    train, held_out = _sets(settings)
    for name, one in (("training", train), ("held out", held_out)):
        emit(f"{name}: {_set_text(one)}")

    def report(point: CurvePoint) -> None:
        emit(
            f"step {point.step} of {settings.steps}: loss {point.loss:.3f}, "
            f"{_precision_text(point.ap)}, {point.seconds:.0f} s"
        )

    from crosscue.detectors.training.job import run_job

    facts = run_job(job, train, held_out, resume=resume, overwrite=overwrite, report=report)
    draw_curve(job.curve_path, path.with_suffix(".curve.png"))
    return TrainedMaskRcnn(path, facts)


def _measure(
    network: str, measuring: Measuring, settings: MaskRcnnTrainingSettings
) -> MeasuredMaskRcnn:
    """Measure the accuracy of a network on COCO annotations, without training it."""
    if not all(1 <= count <= 2000 for count in measuring.proposals):
        raise UsageError("proposals: expected 1 to 2000")
    from crosscue.detectors.networks.devices import chosen_device
    from crosscue.detectors.networks.mask_rcnn.detector import MaskRcnnSettings, checkpoint_named
    from crosscue.detectors.training.annotations import read_training_coco
    from crosscue.detectors.training.measure import measure_network

    device = settings.device if measuring.backend == "torch" else "cpu"
    chosen = chosen_device(device, "train mask-rcnn")
    checkpoint = checkpoint_named(network)
    classes = [name for name in checkpoint.facts.plan.classes if name]
    whole = read_training_coco(Path(settings.data), Path(settings.images), classes)
    labelled = replace(whole, pictures=whole.pictures[_slice(measuring.subset)])
    if not labelled.pictures:
        raise UsageError(
            f"subset: {measuring.subset}: selects none of {len(whole.pictures)}; select others"
        )
    measured: dict[int, NetworkResults] = {}
    for count in measuring.proposals:
        how = {"proposals": count, "threads": settings.threads, "backend": measuring.backend}
        measured[count] = measure_network(
            checkpoint, labelled, MaskRcnnSettings.model_validate(how), chosen
        )
        emit(Progress("measuring", len(measured), len(measuring.proposals), "measurements"))
    return MeasuredMaskRcnn(network, len(labelled.pictures), measured)


def _set_text(one: LabelledSet) -> str:
    """Return the numbers of pictures, of objects without a mask, and of what was left out."""
    text, bare = counted(len(one.pictures), "picture"), one.objects - one.masks
    if bare:
        text += f", {bare} of {counted(one.objects, 'object')} without a mask"
    left_out = ", ".join(f"{count} {why}" for why, count in sorted(one.left_out.items()))
    return f"{text}; {left_out}" if left_out else text


def _precision_text(ap: Mapping[str, float | None]) -> str:
    mask = ap.get("mask")
    return f"box AP {ap.get('box')}, " + ("no masks" if mask is None else f"mask AP {mask}")


def _check(settings: MaskRcnnTrainingSettings, output: Path) -> None:
    if output.suffix != ".safetensors":
        raise UsageError(f"output: {output}, expected a name that ends in .safetensors")
    for name in ("steps", "batch", "check_every", "check_images", "threads"):
        if getattr(settings, name) < 1:
            raise UsageError(f"{name}: expected 1 or more")
    if not 0.0 < settings.learning_rate < 1.0 or settings.seed < 0:
        raise UsageError(
            "learning_rate, seed: expected a rate between 0 and 1, and a seed of 0 or more"
        )
    if not 0.0 <= settings.balance <= 1.0:
        raise UsageError(f"balance: {settings.balance}, expected 0 to 1")
    width_px, height_px = settings.window_px
    if any(side % 32 or not 64 <= side <= MAX_WINDOW_PX for side in (width_px, height_px)):
        raise UsageError(
            f"window_px: {width_px} {height_px}, expected multiples of 32 from 64 to "
            f"{MAX_WINDOW_PX}"
        )
    if not all(settings.classes) or len(set(settings.classes)) != len(settings.classes):
        raise UsageError("classes: a name is empty or repeated; name each class once")
    if (settings.val_data is None) != (settings.val_images is None):
        raise UsageError("val_data, val_images: expected both or neither")


def _slice(text: str | None) -> slice:
    """Parse a slice ``A:B:N``, any number of which may be missing.

    Raises:
        UsageError: The text is not a slice.
    """
    match = re.fullmatch(r"(\d{0,9}):(\d{0,9})(?::([1-9]\d{0,8})?)?", text or ":")
    if match is None:
        raise UsageError(f"subset: {text}, expected A:B:N, as 300: or 300:600 or ::4")
    return slice(*(int(part) if part else None for part in match.groups()))


def _sets(settings: MaskRcnnTrainingSettings) -> tuple[LabelledSet, LabelledSet]:
    from crosscue.detectors.training.annotations import read_training_coco

    whole = read_training_coco(Path(settings.data), Path(settings.images), settings.classes)
    if settings.val_data is not None and settings.val_images is not None:
        held_out = read_training_coco(
            Path(settings.val_data), Path(settings.val_images), settings.classes
        )
        return whole, held_out
    rest = tuple(one for i, one in enumerate(whole.pictures) if i % HELD_EVERY)
    if not rest:
        raise UsageError(
            f"{settings.data}: expected two pictures or more, found one; add some, or --val-data"
        )
    return replace(whole, pictures=rest), replace(whole, pictures=whole.pictures[::HELD_EVERY])


def _job(settings: MaskRcnnTrainingSettings, output: Path) -> TrainingJob:
    from pydantic import ValidationError

    from crosscue.detectors.networks.mask_rcnn.network import NetworkPlan
    from crosscue.detectors.training.job import TrainingJob, architecture_of
    from crosscue.detectors.training.loop import Schedule
    from crosscue.detectors.training.samples import SampleSettings

    start, steps, window_px = str(settings.init), settings.steps, settings.window_px
    try:
        plan = NetworkPlan.model_validate(
            {
                "architecture": architecture_of(start),
                "classes": settings.classes,
                "width_px": settings.width_px,
                "top": settings.crop_top,
                "bottom": settings.crop_bottom,
            }
        )
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = ".".join(str(part) for part in first["loc"]) or "--crop-top, --crop-bottom"
        raise UsageError(f"train mask-rcnn: {name}: {first['msg'].lower()}") from None
    return TrainingJob(
        start=start,
        plan=plan,
        schedule=Schedule(
            steps, settings.batch, settings.learning_rate, min(100, steps), seed=settings.seed
        ),
        window=SampleSettings(*window_px, balance=settings.balance),
        output=output,
        check_every=settings.check_every,
        check_pictures=settings.check_images,
        device=settings.device,
        threads=settings.threads,
        recipe={
            "data": Path(settings.data).parent.name,
            "window": str(list(window_px)),
            "balance": settings.balance,
        },
        made_of=_made_of(settings),
    )


def _made_of(settings: MaskRcnnTrainingSettings) -> dict[str, Any]:
    """Return the inputs that determine the training: data, initial weights and settings."""
    places = [settings.data, settings.images, settings.val_data, settings.val_images]
    if (start := Path(settings.init)).is_file():
        places.append(start)
    names = ("classes", "steps", "batch", "learning_rate", "seed", "balance")
    more = ("crop_top", "crop_bottom", "check_every", "check_images")
    return made_of(
        [Path(path) for path in places if path is not None],
        {name: getattr(settings, name) for name in (*names, *more)}
        | {"width": settings.width_px, "window": settings.window_px}
        | {"init": start.name if start.is_file() else str(settings.init)},
    )
