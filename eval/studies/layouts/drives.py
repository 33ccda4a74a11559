"""Finished drives of the study of layouts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.eval.scoring.truth import DriveTruth, load


@dataclass(frozen=True, slots=True, eq=False)
class StudyDrive:
    """A drive of the study with its truth.

    Attributes:
        name: Layout and run.
        layout: Its name.
        fold: It is tested in.
        features: What is true of the layout, as far as that can be said.
        run: Finished.
        truth: Of the drive.
    """

    name: str
    layout: str
    fold: int
    features: Mapping[str, bool]
    run: RunFolder
    truth: DriveTruth


def open_drive(
    out: Path, name: str, layout: str, fold: int, features: Mapping[str, bool]
) -> StudyDrive:
    """A drive whose run is finished.

    Raises:
        RunError: It is not there, or damaged.
        AnnotationError: Its truth does not fit.
    """
    truth = load(out / "drives" / name, name)
    return StudyDrive(name, layout, fold, features, open_run(out / "runs" / name), truth)
