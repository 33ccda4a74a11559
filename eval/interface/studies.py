"""The Monte Carlo studies: how far a vehicle gets with little information."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.studies.town.settings import LandmarkStudy, RangeStudy

if TYPE_CHECKING:
    import pyarrow as pa

    from crosscue.eval.studies.town.whole import Made


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StudyResult:
    """A finished study; printed as its tables beside the published ones.

    Attributes:
        study: What was driven.
        made: Its folder, its tables in words, and what to know when reading them.
    """

    study: RangeStudy | LandmarkStudy
    made: Made

    @property
    def folder(self) -> Path:
        """Where drives, figures and page are."""
        return self.made.folder

    @property
    def drives(self) -> pa.Table:
        """Every drive is a row."""
        return RunFolder(self.folder).table("drives")

    def draw_drive(self, row: int) -> Path:
        """Draw one drive again, by its row in ``drives``; a picture in the study's folder."""
        from crosscue.eval.studies.town import drive_figure
        from crosscue.localization.town.drive import drive_traced

        drives = self.drives
        settings = self.study.cases()[drives["case"][row].as_py()].settings
        seed = drives["seed"][row].as_py()
        return drive_figure.draw(settings, drive_traced(settings, seed), seed, self.folder)

    def __repr__(self) -> str:
        tables = "\n\n".join(table.as_text() for table in self.made.tables)
        return "\n".join([tables, *self.made.notes])


def run_study(
    study: RangeStudy | LandmarkStudy,
    output: Path | str,
    workers: int | None = None,
    *,
    ray: str | None = None,
    overwrite: bool = False,
) -> StudyResult:
    """Drive a study and summarise it; an interrupted one goes on where it stopped.

    Args:
        study: ``RangeStudy()`` or ``LandmarkStudy()``, its fields changed as wanted.
        output: Folder for drives, figures and page.
        workers: Cores; all, if left out.
        ray: Address of a Ray cluster to drive on.
        overwrite: Replace another study's results.

    Raises:
        RunError: The folder holds another study's results.
    """
    from crosscue.eval.studies.town.whole import drive_study, finish_landmarks, finish_range
    from crosscue.eval.studies.town.work import default_workers

    folder = Path(output)
    for _ in drive_study(study, folder, workers or default_workers(), ray, overwrite=overwrite):
        pass
    if isinstance(study, RangeStudy):
        return StudyResult(study, finish_range(study, folder))
    return StudyResult(study, finish_landmarks(study, folder))
