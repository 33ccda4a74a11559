"""The published experiment on simulated drives: distances, cues and beliefs beside the text's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from crosscue.eval.batch.engine import engine_of
from crosscue.eval.batch.jobs import Done, Progress, exit_status_of
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.studies.intersections.report import StudyFiles, summary, write_study
from crosscue.eval.studies.intersections.settings import IntersectionStudy
from crosscue.eval.studies.intersections.study import score_study
from crosscue.eval.studies.intersections.tables import StudyScores
from crosscue.eval.studies.simulated_drives import run_drives
from crosscue.replay.base import RunError, json_tree, visible


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class IntersectionResult:
    """The published experiment, simulated; printed as its tables beside the published numbers.

    Attributes:
        drives: The outcome of each drive.
        scored: Distances, cues and beliefs, and what each cue was worth.
        files: The page, its tables as JSON, the metrics and a sheet of pictures.
    """

    drives: tuple[Done[Outcome], ...]
    scored: StudyScores
    files: StudyFiles

    @property
    def exit_status(self) -> int:
        """0 when all is whole; 3 when a drive failed or something was dropped."""
        return exit_status_of(self.drives)

    def as_dict(self) -> object:
        """What ``crosscue study intersections --json`` prints: the tables in its folder."""
        return json_tree(self.files.tables.read_text(encoding="utf-8"))

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
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> IntersectionResult:
    """Simulate every drive of a study, replay it from its pixels and score it.

    An interrupted study goes on with the drives that are missing.

    Args:
        study: ``IntersectionStudy()``, its fields changed as wanted.
        output: Folder for drives, runs, tables and page.
        workers: Drives side by side.
        ray: Address of a Ray cluster that shares ``output``.
        attribution: Find what each cue was worth, by leaving it out.
        on_progress: As in ``replay_drives``.

    Raises:
        UsageError: Too few workers.
        VehicleError: The vehicle file cannot be read.
        RunError: Every drive failed; with the first reason.
        OutputError: A file cannot be written.
    """
    folder = Path(output)
    done = run_drives(
        folder,
        study.scenes(),
        study.detectors,
        engine_of(workers, ray),
        on_progress,
        vehicle=study.vehicle,
    )
    names = [one.job.name for one in done if one.error is None]
    if not names:
        raise RunError(f"{folder}: every drive failed; the first: {done[0].error}")
    scored = score_study(folder, names, attribution=attribution)
    return IntersectionResult(done, scored, write_study(folder, study, done, scored))
