"""Repeat the published experiment on simulated drives, and compare with its results."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from crosscue.eval.batch.engine import engine_of
from crosscue.eval.batch.jobs import Done, exit_status_of
from crosscue.eval.drives.replay import choices_for
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.studies.intersections.report import StudyFiles, summary, write_study
from crosscue.eval.studies.intersections.settings import IntersectionStudy
from crosscue.eval.studies.intersections.study import score_study
from crosscue.eval.studies.intersections.tables import StudyScores
from crosscue.eval.studies.simulated_drives import run_drives
from crosscue.replay.base import RunError, door, json_tree, visible
from crosscue.replay.vehicle.vehicle import vehicle_given


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class IntersectionResult:
    """Results of the simulated experiment; its repr is tables with the published numbers.

    Attributes:
        drives: Outcome of each drive.
        scored: Scores of distances, cues and beliefs, and of the ablation of each cue.
        files: The page, its tables as JSON, the metrics and a contact sheet.
    """

    drives: tuple[Done[Outcome], ...]
    scored: StudyScores
    files: StudyFiles

    @property
    def exit_status(self) -> int:
        """0 if all drives are complete; 3 if a drive failed or something was dropped."""
        return exit_status_of(self.drives)

    def as_dict(self) -> object:
        """Return the JSON output of ``crosscue study intersections``: the tables in its folder."""
        return json_tree(door.read(self.files.tables))

    def __repr__(self) -> str:
        text = summary(self.drives, self.scored, self.files)
        return "\n".join(map(visible, text.split("\n")))


def run_intersection_study(
    study: IntersectionStudy,
    output: Path | str,
    workers: int = 1,
    *,
    ray: str | None = None,
    attribution: bool = True,
) -> IntersectionResult:
    """Simulate every drive of a study, replay it from its pictures, and score it.

    An interrupted study continues with the missing drives.

    Args:
        study: ``IntersectionStudy()``, with any fields changed.
        output: Folder for drives, runs, tables and page.
        workers: Number of drives in parallel.
        ray: Address of a Ray cluster that shares ``output``.
        attribution: Run an ablation of each cue.

    Raises:
        UsageError: ``workers`` is below 1, or a detector does not exist.
        VehicleError: The vehicle file or a model card cannot be read.
        RunError: Every drive failed; the message contains the first reason.
        OutputError: A file cannot be written.
    """
    choices_for(vehicle_given(study.vehicle), study.detectors.split(","))
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
    scored = score_study(folder, names, attribution=attribution)
    return IntersectionResult(done, scored, write_study(folder, study, done, scored))
