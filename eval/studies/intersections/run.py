"""Repeat the published experiment on simulated drives, and compare with its results."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

from crosscue.detectors.registry import check, chosen
from crosscue.eval.batch.jobs import JobOutcome, exit_status_of
from crosscue.eval.batch.ray_jobs import engine_of
from crosscue.eval.pipeline.detect import choices_of
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.studies.simulated_drives import run_drives
from crosscue.eval.studies.study import StudyResult
from crosscue.replay.errors import RunError
from crosscue.replay.vehicle.vehicle import vehicle_given
from crosscue.results import HIDDEN
from crosscue.verb import Option

from .report import SHEET, TABLES, write_study
from .settings import IntersectionStudy
from .study import score_intersection_study
from .tables import StudyScores


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class IntersectionResult(StudyResult):
    """Results of the simulated experiment; its repr is tables with the published numbers.

    Attributes:
        drives: Outcome of each drive.
        scored: Scores of distances, cues and beliefs, and of the ablation of each cue.
    """

    drives: tuple[JobOutcome[Outcome], ...] = field(metadata=HIDDEN)
    scored: StudyScores = field(metadata=HIDDEN)

    files: ClassVar = {TABLES: "tables", SHEET: "pictures: a frame of each drive, with detections"}

    @property
    def exit_status(self) -> int:
        """0 if all drives are complete; 3 if a drive failed or something was dropped."""
        return exit_status_of(self.drives)


def run_intersection_study(
    study: IntersectionStudy,
    output: Path | str,
    *,
    workers: int = 1,
    ray: str | None = None,
    attribution: Annotated[bool, Option("--no-attribution")] = True,
) -> IntersectionResult:
    """Repeat the published experiment on simulated drives, and compare results.

    Simulates each drive, replays it from its pictures with the embedded detectors, scores it, and
    writes study.html, study.json and score/metrics.json. Distances, cues and beliefs are shown next
    to the published ones. A second start processes only the missing drives.

    Example:
        crosscue study intersections -o study --runs 10 --workers 2

    Args:
        study: Settings of the study.
        output: Folder for drives, runs, tables and page.
        workers: Number of drives in parallel.
        ray: Run on a Ray cluster that shares DIR: its address, auto, or local.
        attribution: Skip the ablation of each cue.

    Raises:
        UsageError: ``workers`` is below 1, or a detector does not exist.
        VehicleError: The vehicle file or a model card cannot be read.
        RunError: Every drive failed; the message contains the first reason.
        OutputError: A file cannot be written.
    """
    vehicle = vehicle_given(study.vehicle)
    for choice in chosen(study.detectors.split(","), choices_of(vehicle)):
        check(choice)
    folder = Path(output)
    done = run_drives(
        folder,
        study.scenes(),
        study.detectors,
        engine_of(workers, ray),
        vehicle=study.vehicle,
    )
    names = [one.job.name for one in done if one.error is None]
    if not names:
        raise RunError(f"{folder}: every drive failed; the first: {done[0].error}")
    scored = score_intersection_study(folder, names, attribution=attribution)
    tables = write_study(folder, study, done, scored)
    return IntersectionResult(folder, tables, (), done, scored)
