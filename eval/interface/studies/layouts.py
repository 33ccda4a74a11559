"""Fit beliefs to random layouts, with and without intersections, and test them on others."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from crosscue.datasets.scenes.faulty_labels import DETECTORS, LABEL_IMAGES
from crosscue.eval.batch.engine import engine_of
from crosscue.eval.batch.jobs import exit_status_of
from crosscue.eval.studies.layouts.drives import open_drive
from crosscue.eval.studies.layouts.report import (
    LayoutFiles,
    LayoutScores,
    tables_of,
    write_layout_study,
)
from crosscue.eval.studies.layouts.settings import LayoutStudy, Perception
from crosscue.eval.studies.layouts.study import OnStep, score_study
from crosscue.eval.studies.simulated_drives import SPARSE_AND_EMBEDDED, run_drives
from crosscue.replay.base import RunError, door, json_tree

SEEN_BY: Final = {
    "pixels": SPARSE_AND_EMBEDDED,
    "faults": (LABEL_IMAGES, DETECTORS),
}
"""Source of the recorded images, and detectors, by perception."""
IN_WORDS: Final = {"pixels": "perceived by networks", "faults": "simulated detectors, no network"}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LayoutResult:
    """Scores of beliefs on layouts that they were not fitted to; its repr is tables.

    Attributes:
        perception: Source of detections, ``pixels`` or ``faults``.
        scores: Scores of each belief, and of its ablations of cues and rules.
        files: The page, and its tables as JSON.
        failures: Reasons by name of the drives that failed.
        exit_status: 0 if all drives are complete; 3 if a drive failed or something was dropped.
    """

    perception: Perception
    scores: LayoutScores
    files: LayoutFiles
    failures: dict[str, str]
    exit_status: int

    def as_dict(self) -> object:
        """Return the JSON output of ``crosscue study layouts``: the tables in its folder."""
        return json_tree(door.read(self.files.tables))

    def __repr__(self) -> str:
        parts = [
            f"{self.scores.drives} simulated drives over {self.scores.layouts} layouts, "
            f"{IN_WORDS[self.perception]}",
            *(f"  failed {name}: {why}" for name, why in self.failures.items()),
            *("\n" + table.as_text() for table in tables_of(self.scores)),
            f"\nwritten to {self.files.page}",
        ]
        return "\n".join(parts)


def run_layout_study(
    study: LayoutStudy,
    output: Path | str,
    workers: int = 1,
    *,
    ablation: bool = True,
    on_step: OnStep = lambda what, done, of: None,
) -> LayoutResult:
    """Simulate every drive, find its cues, and score beliefs by cross-validation over layouts.

    An interrupted study continues with the missing drives. Drives are kept, so that beliefs can be
    scored again in minutes.

    Args:
        study: ``LayoutStudy()``, with any fields changed.
        output: Folder for drives, runs, tables and page.
        workers: Number of drives in parallel.
        ablation: Run an ablation of each cue and each rule.
        on_step: Called with the name of the current step, the amount done, and the total.

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
    failures = {one.job.name: one.error for one in done if one.error is not None}
    drives = [
        open_drive(
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
    scores = score_study(drives, ablation=ablation, on_step=on_step)
    files = write_layout_study(folder, study, scores, failures)
    return LayoutResult(study.perception, scores, files, failures, exit_status_of(done))
