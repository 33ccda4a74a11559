"""Drives of the study of layouts, from seeds to finished runs; one that is there is not redone.

A run keeps what the simulated detector found, so every belief is estimated from it in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

from crosscue.datasets.scenes.drive import write_scene
from crosscue.datasets.scenes.faulty_labels import DETECTORS, LABEL_IMAGES
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.datasets.truth.truth import FILE
from crosscue.detectors.registry import chosen
from crosscue.eval.batch.jobs import Done, Engine, Job, Progress, fingerprint_of, run_many
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.pipeline.replay import Detecting, replay_drive
from crosscue.eval.runs.folder import create
from crosscue.replay.base import EVERYTHING, versions
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.vehicle import load

from .settings import LayoutStudy

LOG: Final = "drive.mcap"
VEHICLE: Final = "vehicle.toml"


@dataclass(frozen=True, slots=True)
class Work:
    """What is done for one drive, here or in another process.

    Attributes:
        drives: Folder of the simulated drives.
        scenes: By name.
    """

    drives: Path
    scenes: Mapping[str, SceneSettings]

    def __call__(self, job: Job) -> Outcome:
        """Simulate the drive unless it is there, then replay it."""
        folder = self.drives / job.name
        if not (folder / FILE).exists():
            write_scene(folder, self.scenes[job.name], overwrite=True, imager=LABEL_IMAGES)
        run = create(job.run, overwrite=True)
        detecting = Detecting(chosen(DETECTORS, {}))
        with open_log(folder / LOG) as log:
            vehicle = load(folder / VEHICLE)
            outcome = replay_drive([log], vehicle, run, EVERYTHING, detecting=detecting)
        return replace(outcome, ledgers=(), detected=None)


def perceive(
    out: Path,
    settings: LayoutStudy,
    engine: Engine,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> tuple[Done[Outcome], ...]:
    """Simulate and replay all drives that are not there yet, below ``out``."""
    scenes = {scene.name: scene for scene in settings.scenes()}
    jobs = [
        Job(name, (), out / "runs" / name, fingerprint_of(asdict(scene), DETECTORS, versions()))
        for name, scene in scenes.items()
    ]
    work = Work(out / "drives", scenes)
    return run_many(jobs, work, engine, overwrite=True, on_progress=on_progress)
