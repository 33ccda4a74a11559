"""Open the finished drives of the study of layouts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.eval.scoring.truth import DriveTruth, read_scored_truth


@dataclass(frozen=True, slots=True, eq=False)
class LayoutDrive:
    """A drive of the study with its truth.

    Attributes:
        name: Name of the drive, from layout and run.
        layout: Name of the layout.
        fold: Fold that it is tested in.
        features: True features of the layout, where known.
        run: The finished run.
        truth: Truth of the drive.
    """

    name: str
    layout: str
    fold: int
    features: Mapping[str, bool]
    run: RunFolder
    truth: DriveTruth


def open_study_drive(
    out: Path, name: str, layout: str, fold: int, features: Mapping[str, bool]
) -> LayoutDrive:
    """Open a drive whose run is finished.

    Raises:
        RunError: The run is missing or damaged.
        AnnotationError: The truth does not fit.
    """
    truth = read_scored_truth(out / "drives" / name, name)
    return LayoutDrive(name, layout, fold, features, open_run(out / "runs" / name), truth)
