"""Fit beliefs to random layouts, with and without intersections, and test them on others."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from crosscue.datasets.scenes.faulty_labels import DETECTORS, LABEL_IMAGES
from crosscue.eval.batch.jobs import JobOutcome, exit_status_of
from crosscue.eval.batch.ray_jobs import engine_of
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.studies.result import StoredResult
from crosscue.eval.studies.simulated_drives import SPARSE_AND_EMBEDDED, run_drives
from crosscue.replay.errors import RunError
from crosscue.verb import Option

from .drives import open_study_drive
from .report import LayoutFiles, LayoutScores, study_tables, write_layout_study
from .settings import LayoutStudy, Perception
from .study import score_layout_study

# Source of the recorded images, and detectors, by perception.
SEEN_BY: Final = {
    "pixels": SPARSE_AND_EMBEDDED,
    "faults": (LABEL_IMAGES, DETECTORS),
}
IN_WORDS: Final = {"pixels": "perceived by networks", "faults": "simulated detectors, no network"}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LayoutResult(StoredResult):
    """Scores of beliefs on layouts that they were not fitted to; its repr is tables.

    Attributes:
        perception: Source of detections, ``pixels`` or ``faults``.
        scores: Scores of each belief, and of its ablations of cues and rules.
        files: The page, and its tables as JSON.
        drives: Outcome of each drive.
    """

    perception: Perception
    scores: LayoutScores
    files: LayoutFiles
    drives: tuple[JobOutcome[Outcome], ...]

    @property
    def exit_status(self) -> int:
        """0 if all drives are complete; 3 if a drive failed or something was dropped."""
        return exit_status_of(self.drives)

    @property
    def stored(self) -> Path:
        """Its tables as JSON."""
        return self.files.tables

    def lines(self) -> Iterator[str]:
        """Yield the tables."""
        yield (
            f"{self.scores.drives} simulated drives over {self.scores.layouts} layouts, "
            f"{IN_WORDS[self.perception]}"
        )
        yield from (f"  failed {name}: {why}" for name, why in _failures(self.drives).items())
        yield from ("\n" + table.as_text() for table in study_tables(self.scores))
        yield f"\nwritten to {self.files.page}"


def _failures(drives: tuple[JobOutcome[Outcome], ...]) -> dict[str, str]:
    return {one.job.name: one.error for one in drives if one.error is not None}


def run_layout_study(
    study: LayoutStudy,
    output: Path | str,
    *,
    workers: int = 1,
    ablation: Annotated[bool, Option("--no-ablation")] = True,
) -> LayoutResult:
    """Fit beliefs to random simulated layouts, and test them on other layouts.

    There are thirteen kinds of layouts, five of them without an intersection. Every drive is
    rendered and processed by the embedded networks, and each belief is scored on layouts that it
    was not fitted to. With --perception faults, no network runs: the renderer's masks are used,
    with simulated faults. Writes study.html and study.json. A second start processes only the
    missing drives.

    Example:
        crosscue study layouts -o layouts --workers 2

    Args:
        study: Settings of the study.
        output: Folder for drives, runs, tables and page.
        workers: Number of drives in parallel.
        ablation: Skip the ablation of cues and rules.

    Raises:
        UsageError: ``workers`` is below 1.
        RunError: All drives of a fold failed.
        OutputError: A file cannot be written.
    """
    folder = Path(output)
    imager, detectors = SEEN_BY[study.perception]
    done = run_drives(
        folder,
        study.scenes(),
        detectors,
        engine_of(workers, None),
        imager=imager,
    )
    failures = _failures(done)
    drives = [
        open_study_drive(
            folder,
            scene.name,
            scene.layout,
            study.fold_of(scene.layout),
            study.features_of(scene.layout),
        )
        for scene in study.scenes()
        if scene.name not in failures
    ]
    folds = {one.fold for one in drives}
    if len(folds) < study.folds:
        first = next(iter(failures.items()))
        raise RunError(f"{folder}: all drives of a fold failed; the first: {': '.join(first)}")
    scores = score_layout_study(drives, ablation=ablation)
    files = write_layout_study(folder, study, scores, failures)
    return LayoutResult(study.perception, scores, files, done)
