"""Random layouts, negatives among them: beliefs fitted on some and tested on the others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from crosscue.datasets.scenes.faulty_labels import DETECTORS, LABEL_IMAGES
from crosscue.eval.batch.engine import engine_of
from crosscue.eval.batch.jobs import Progress, exit_status_of
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
from crosscue.replay.base import RunError, json_tree

SEEN_BY: Final = {
    "pixels": SPARSE_AND_EMBEDDED,
    "faults": (LABEL_IMAGES, DETECTORS),
}
"""From a perception to what cameras record and the detectors that look at it."""
SEEN: Final = {"pixels": "seen by networks", "faults": "simulated detectors, no network"}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LayoutResult:
    """Beliefs about layouts that had no part in their fit; printed as tables.

    Attributes:
        perception: What found the cues.
        scores: Of each belief, and of each with a cue or rule left out.
        files: The page, and its tables as JSON.
        failures: From drives that failed to why.
        exit_status: 0 when all is whole; 3 when a drive failed or something was dropped.
    """

    perception: Perception
    scores: LayoutScores
    files: LayoutFiles
    failures: dict[str, str]
    exit_status: int

    def as_dict(self) -> object:
        """What ``crosscue study layouts --json`` prints: the tables in its folder."""
        return json_tree(self.files.tables.read_text(encoding="utf-8"))

    def __repr__(self) -> str:
        parts = [
            f"{self.scores.drives} simulated drives over {self.scores.layouts} layouts, "
            f"{SEEN[self.perception]}",
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
    on_progress: Callable[[Progress], None] = lambda progress: None,
    on_step: OnStep = lambda what, done, of: None,
) -> LayoutResult:
    """Simulate every drive, find its cues as the study says, and judge beliefs by fold.

    An interrupted study goes on with the drives that are missing; drives are kept, so that beliefs
    are judged again in minutes.

    Args:
        study: ``LayoutStudy()``, its fields changed as wanted.
        output: Folder for drives, runs, tables and page.
        workers: Drives side by side.
        ablation: Leave out each cue and each rule.
        on_progress: As in ``replay_drives``.
        on_step: Called with what is being judged, how much of it is done, and of how much.

    Raises:
        UsageError: Too few workers.
        RunError: A fold has no drive that did not fail.
        OutputError: A file cannot be written.
    """
    folder = Path(output)
    imager, detectors = SEEN_BY[study.perception]
    done = run_drives(
        folder,
        study.scenes(),
        detectors,
        engine_of(workers, None),
        on_progress,
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
        raise RunError(f"{folder}: a fold has no drive; the first that failed: {': '.join(first)}")
    scores = score_study(drives, ablation=ablation, on_step=on_step)
    files = write_layout_study(folder, study, scores, failures)
    return LayoutResult(study.perception, scores, files, failures, exit_status_of(done))
