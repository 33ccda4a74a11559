"""Train a network from annotations to a checkpoint, with validation and resumption."""

import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
import torch
from torch import Tensor

from crosscue.detectors.networks.devices import chosen_device
from crosscue.detectors.networks.mask_rcnn.checkpoint import (
    Calibration,
    Checkpoint,
    Facts,
    save_checkpoint,
)
from crosscue.detectors.networks.mask_rcnn.coco import COCO_NETWORKS
from crosscue.detectors.networks.mask_rcnn.detector import MaskRcnnSettings, checkpoint_named
from crosscue.detectors.networks.mask_rcnn.network import (
    NetworkPlan,
    build_network,
    forward_training,
    freeze_masks,
)
from crosscue.replay.errors import OutputError
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import json_tree, strict_json
from crosscue.replay.files.whole_file import write_text

from .annotations import LabelledSet
from .loop import Learner, Schedule, decides_bits, reproducible
from .measure import average_precisions, fitted, judged, rates_by_score, raw_detections
from .operating_point import Verdicts
from .samples import Sample, Sampler, SampleSettings

COMPACT: Final = "compact"
Recipe: TypeAlias = dict[str, str | int | float]


@dataclass(frozen=True, slots=True)
class TrainingJob:
    """A training and its outputs.

    Attributes:
        start: ``compact``, ``resnet50``, ``resnet50-v2`` (with COCO weights), or a checkpoint.
        plan: Architecture and input of the network.
        schedule: Number of steps and learning rates.
        window: Size and augmentation of samples.
        output: Path of the checkpoint; its curve and state are stored next to it.
        check_every: Number of steps between validations.
        check_pictures: Maximum number of pictures per validation; the last one uses all.
        device: Device, as in the detector's setting.
        threads: Number of threads on a CPU.
        recipe: Description of the training for the checkpoint.
        made_of: Annotations, pictures and settings; a training with other ones is not resumed.
    """

    start: str
    plan: NetworkPlan
    schedule: Schedule
    window: SampleSettings
    output: Path
    check_every: int
    check_pictures: int
    device: str = "auto"
    threads: int = 1
    recipe: Recipe = field(default_factory=dict)
    made_of: dict[str, Any] = field(default_factory=dict)

    @property
    def state_path(self) -> Path:
        """State file, from which an interrupted training is resumed."""
        return self.output.with_suffix(".state.safetensors")

    @property
    def curve_path(self) -> Path:
        """File of losses and average precisions during training."""
        return self.output.with_suffix(".curve.json")


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """One point of the training curve.

    Attributes:
        step: Number of steps so far.
        loss: Mean loss since the last point.
        seconds: Training time so far, without validations.
        ap: Average precision by name; empty without a validation.
    """

    step: int
    loss: float
    seconds: float
    ap: dict[str, float | None] = field(default_factory=dict)


class Training(Learner):
    """A Mask R-CNN in training; ``steps`` trains, ``save`` and ``resume`` keep its state."""

    def __init__(
        self,
        make: Callable[[], Any],
        schedule: Schedule,
        device: torch.device,
        *,
        learns_masks: bool = True,
    ) -> None:
        """Build the network and its average.

        Args:
            make: Builds the network with its initial weights.
            schedule: Number of steps and learning rates.
            device: Device of the training.
            learns_masks: False to freeze the mask head.
        """
        torch.manual_seed(schedule.seed)
        network = make().to(device).to(memory_format=torch.channels_last).train()
        freeze_masks(network, is_frozen=not learns_masks)
        averaged = make().to(device).to(memory_format=torch.channels_last).eval()
        averaged.load_state_dict(network.state_dict())
        averaged.requires_grad_(False)
        super().__init__(network, _groups(network, schedule.decay), schedule, device, averaged)

    def steps(self, sampler: Sampler) -> Iterator[tuple[int, float]]:
        """Train, and yield number and loss of each step.

        Raises:
            LogError: A picture cannot be read.
            CrosscueError: The losses are no longer finite.
        """
        schedule = self.schedule
        first, last = self.done * schedule.batch, schedule.steps * schedule.batch
        with ThreadPoolExecutor(1, "samples") as pool:
            # The next batch is prepared during the current step.
            waiting = [
                pool.submit(sampler, k) for k in range(first, min(first + schedule.batch, last))
            ]
            while self.done < schedule.steps:
                batch = [future.result() for future in waiting]
                first += schedule.batch
                waiting = [
                    pool.submit(sampler, k) for k in range(first, min(first + schedule.batch, last))
                ]
                loss = self.learn(partial(self._loss, batch))
                yield self.done, loss

    def _loss(self, batch: list[Sample]) -> Tensor:
        pictures = torch.from_numpy(np.stack([sample.pixels for sample in batch]))
        pictures = pictures.to(self.device, memory_format=torch.channels_last)
        targets = [_target(sample, self.device) for sample in batch]
        with torch.autocast(
            self.device.type, enabled=self.device.type == "cuda", dtype=torch.bfloat16
        ):
            return forward_training(self.network, pictures, targets)


def _groups(network: Any, decay: float) -> list[dict[str, Any]]:
    """Group parameters: weights with decay, biases and normalisations without."""
    learns = [p for p in network.parameters() if p.requires_grad]
    return [
        {"params": [p for p in learns if p.ndim > 1], "weight_decay": decay},
        {"params": [p for p in learns if p.ndim <= 1], "weight_decay": 0.0},
    ]


def _target(sample: Sample, device: torch.device) -> dict[str, Tensor]:
    columns = {
        "boxes": sample.boxes_px,
        "labels": sample.labels,
        "masks": sample.masks,
        "has_mask": sample.has_mask,
    }
    return {name: torch.from_numpy(column).to(device) for name, column in columns.items()}


def run_job(
    job: TrainingJob,
    train: LabelledSet,
    held_out: LabelledSet,
    *,
    resume: bool,
    overwrite: bool,
    report: Callable[[CurvePoint], None],
) -> Facts:
    """Train, validate, calibrate and write a checkpoint; return its description.

    Raises:
        OutputError: An output file exists or cannot be written.
        LogError: A picture cannot be read.
        SchemaError: The state to resume is damaged.
        UsageError: The state to resume is of another training.
        VehicleError: The network to start from does not match the plan.
        CrosscueError: The losses are no longer finite.
    """
    if not (resume and job.state_path.exists()):
        _check_place(job, overwrite)
    device = chosen_device(job.device, "train mask-rcnn")
    torch.set_num_threads(job.threads)
    with reproducible(device):
        return _run(job, train, held_out, device, resume=resume, report=report)


def _run(
    job: TrainingJob,
    train: LabelledSet,
    held_out: LabelledSet,
    device: torch.device,
    *,
    resume: bool,
    report: Callable[[CurvePoint], None],
) -> Facts:
    learns_masks = train.masks > 0
    training = Training(
        lambda: starting_network(job), job.schedule, device, learns_masks=learns_masks
    )
    points: list[CurvePoint] = []
    if resume and job.state_path.exists():
        said = training.resume(job.state_path, job.made_of)
        points = [CurvePoint(**row) for row in said["points"]]
    sampler = Sampler(train, job.plan, job.window, job.schedule.seed)
    for point in _learned(job, training, sampler, held_out, points):
        report(point)
    recipe: Recipe = {"objects": train.objects, "boxes_without_mask": train.objects - train.masks}
    job = replace(job, recipe={**job.recipe, **recipe})
    has_masks = learns_masks or knows_masks(job)
    facts = finished_facts(job, training.averaged, held_out, device, has_masks=has_masks)
    save_checkpoint(job.output, training.averaged, facts)
    job.state_path.unlink(missing_ok=True)
    return facts


def _check_place(job: TrainingJob, overwrite: bool) -> None:
    for path in (job.state_path, job.output):
        if path.exists() and not overwrite:
            how = "--resume continues it, " if path == job.state_path else ""
            raise OutputError(f"{path}: exists; {how}--overwrite starts over")
    job.state_path.unlink(missing_ok=True)


def starting_network(job: TrainingJob) -> Any:
    """Build a network with its initial weights; heads for different classes start at random."""
    network = build_network(job.plan)
    if job.start == COMPACT:
        return network
    begun: Checkpoint = checkpoint_named(job.start)
    wanted = network.state_dict()
    fitting = {
        name: value.to(wanted[name].dtype)
        for name, value in begun.network.state_dict().items()
        if name in wanted and wanted[name].shape == value.shape
    }
    if begun.facts.plan.classes != job.plan.classes:
        fitting = {name: value for name, value in fitting.items() if "predictor" not in name}
    network.load_state_dict(fitting, strict=False)
    return network


def knows_masks(job: TrainingJob) -> bool:
    """Whether the network to start from was trained on masks of exactly the plan's classes."""
    if job.start == COMPACT:
        return False
    facts = checkpoint_named(job.start).facts
    return facts.has_masks and facts.plan.classes == job.plan.classes


def architecture_of(start: str) -> str:
    """Architecture of a named network or of a checkpoint file."""
    if start == COMPACT or start in COCO_NETWORKS:
        return start
    return checkpoint_named(start).facts.plan.architecture


def _learned(
    job: TrainingJob,
    training: Training,
    sampler: Sampler,
    held_out: LabelledSet,
    points: list[CurvePoint],
) -> Iterator[CurvePoint]:
    some = replace(held_out, pictures=_spread(held_out.pictures, job.check_pictures))
    before_s = points[-1].seconds if points else 0.0
    began, checking_s, losses = time.monotonic(), 0.0, list[float]()
    for step, loss in training.steps(sampler):
        if math.isfinite(loss):
            losses.append(loss)
        if step % job.check_every and step != job.schedule.steps:
            continue
        seconds = before_s + time.monotonic() - began - checking_s
        checked = time.monotonic()
        found = raw_detections(
            job.plan,
            training.averaged,
            some,
            MaskRcnnSettings(threads=job.threads),
            training.device,
        )
        point = CurvePoint(
            step,
            float(np.mean(losses or [math.nan])),
            round(seconds, 1),
            average_precisions(some, found),
        )
        points.append(point)
        training.save(
            job.state_path,
            {"points": [asdict(one) for one in points]},
            made_of=job.made_of,
        )
        write_text(job.curve_path, strict_json([asdict(one) for one in points]) + "\n")
        checking_s += time.monotonic() - checked
        losses = []
        yield point


def _spread(pictures: tuple[Any, ...], max_count: int) -> tuple[Any, ...]:
    if len(pictures) <= max_count:
        return pictures
    return tuple(pictures[i] for i in np.linspace(0, len(pictures) - 1, max_count).astype(int))


def finished_facts(
    job: TrainingJob, network: Any, held_out: LabelledSet, device: torch.device, *, has_masks: bool
) -> Facts:
    """Measure average precision and calibrate the scores, for the checkpoint's description.

    The calibration is fitted to the first half of the held-out pictures and measured on the second.
    """
    settings = MaskRcnnSettings(threads=job.threads)
    found = raw_detections(job.plan, network, held_out, settings, device)
    half = len(found) // 2
    first = replace(held_out, pictures=held_out.pictures[:half])
    second = replace(held_out, pictures=held_out.pictures[half:])
    by = {name: fitted(rows) for name, rows in judged(first, found[:half]).items()}
    measured = average_precisions(held_out, found)
    for name, rows in judged(second, found[half:]).items():
        measured |= reported_rates(name, rows, by[name])
    recipe = {
        **job.recipe,
        "start": Path(job.start).name,
        **{f"schedule.{k}": v for k, v in asdict(job.schedule).items()},
        "held_out_pictures": len(held_out.pictures),
        **decides_bits(device),
    }
    return Facts(
        plan=job.plan, calibration=by, recipe=recipe, measured=measured, has_masks=has_masks
    )


def reported_rates(name: str, rows: Verdicts, by: Calibration) -> dict[str, float | None]:
    """Precision and recall of a class at calibrated scores, in percent; None where undefined."""
    reported: dict[str, float | None] = {}
    for aim, at in rates_by_score(rows, by).items():
        for what, fraction in (("precision", at.precision), ("recall", at.recall)):
            reported[f"{what} {name} at {aim}"] = (
                round(100.0 * fraction, 2) if math.isfinite(fraction) else None
            )
    return reported


def read_curve(path: Path) -> list[CurvePoint]:
    """Read the points of a curve file."""
    return [CurvePoint(**row) for row in json_tree(door.read(path))]
