"""Simulate and replay the drives of a study.

Drives are processed in the order of runs (A-01 to H-01, then A-02, ...), so that an interrupted
study has about the same number of drives of each layout. A second start continues with the missing
drives.
"""

import ast
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

from crosscue.datasets.scenes.drive import (
    PHOTOGRAPHS,
    SPARSE_PHOTOGRAPHS,
    Imager,
    refuse_other_drive,
    write_scene,
)
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.detectors.registry import EMBEDDED, chosen
from crosscue.eval.batch.jobs import Engine, Job, JobOutcome, fingerprint_of, run_many
from crosscue.eval.pipeline.detecting import Detecting, choices_of
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.pipeline.whole_run import replay_drive
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import create
from crosscue.replay.files import door
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.vehicle import load
from crosscue.replay.versions import versions

LOG: Final = "drive.mcap"
VEHICLE: Final = "vehicle.toml"
# Camera and detectors of a study of many layouts.
SPARSE_AND_EMBEDDED: Final = (SPARSE_PHOTOGRAPHS, EMBEDDED)
# File in a complete simulated drive's folder, with the key of its settings and of the code.
MADE_BY: Final = "made_by.txt"


@dataclass(frozen=True, slots=True)
class Work:
    """Simulation and replay of one drive, in any process.

    Attributes:
        drives: Folder of the simulated drives.
        scenes: Settings by name of the drive.
        vehicle: Vehicle file to replay with; None for that of each drive.
        detectors: Comma-separated names.
        cache: Folder of the detection caches.
        made_by: Key of the settings and code that simulate the drive, by name.
        imager: Camera that records the pictures.
    """

    drives: Path
    scenes: Mapping[str, SceneSettings]
    vehicle: Path | None
    detectors: str
    cache: Path
    made_by: Mapping[str, str]
    imager: Imager = PHOTOGRAPHS

    def __call__(self, job: Job) -> Outcome:
        """Simulate the drive unless it exists, then replay it."""
        folder = self.simulated(job.name)
        vehicle = load(self.vehicle or folder / VEHICLE)
        choices = chosen(self.detectors, choices_of(vehicle))
        # One cache per drive, so that workers do not wait for each other.
        detecting = Detecting(choices, self.cache / f"{job.name}.sqlite")
        run = create(job.run, overwrite=True)
        with open_log(folder / LOG) as log:
            outcome = replay_drive(Drive([log], vehicle), run, detecting)
        return replace(outcome, ledgers=(), detected=None)

    def simulated(self, name: str) -> Path:
        """Return the drive's folder; simulate it unless it is complete and up to date."""
        folder, key = self.drives / name, self.made_by[name]
        made_by = folder / MADE_BY
        if not made_by.exists() or door.read(made_by) != key.encode():
            scene = self.scenes[name]
            refuse_other_drive(folder, scene, self.imager)
            made_by.unlink(missing_ok=True)
            write_scene(folder, scene, overwrite=True, imager=self.imager, is_calibrated=False)
            write_text(made_by, key)
        return folder


def code_of(folder: str) -> str:
    """Return a hash of a folder's code, which does not depend on comments and docstrings."""
    digest = hashlib.sha256()
    for source in sorted((Path(__file__).parents[2] / folder).rglob("*.py")):
        digest.update(code_meaning(source.read_text(encoding="utf-8")).encode())
    return digest.hexdigest()


def code_meaning(source: str) -> str:
    """Return a module's syntax tree without docstrings and comments."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            body[:] = [one for one in body if not _is_text(one)]
    return ast.dump(tree)


def _is_text(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def run_drives(
    out: Path,
    scenes: Sequence[SceneSettings],
    detectors: str,
    engine: Engine,
    *,
    vehicle: Path | None = None,
    imager: Imager = PHOTOGRAPHS,
) -> tuple[JobOutcome[Outcome], ...]:
    """Simulate and replay all missing drives below ``out``.

    Args:
        out: Folder of the study.
        scenes: Settings of the drives, in the order of processing.
        detectors: Comma-separated names, as for ``crosscue replay``.
        engine: Engine that runs the work.
        vehicle: Vehicle file to replay with; default: that of each drive.
        imager: Camera that records the pictures.

    Raises:
        VehicleError: The vehicle file cannot be read.
    """
    by_name = {scene.name: scene for scene in scenes}
    settings = None if vehicle is None else load(vehicle).model_dump(mode="json")
    scene_code = code_of("datasets/scenes")
    made_by = {
        name: fingerprint_of(asdict(scene), imager.name, scene_code)
        for name, scene in by_name.items()
    }
    found_by = (settings, detectors, code_of("detectors"), versions())
    jobs = [
        Job(
            name=name,
            logs=(),
            run=out / "runs" / name,
            fingerprint=fingerprint_of(made_by[name], *found_by),
        )
        for name in by_name
    ]
    work = Work(out / "drives", by_name, vehicle, detectors, out / "cache", made_by, imager)
    return run_many(jobs, work, engine, overwrite=True, doing="driving")
