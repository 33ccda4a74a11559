"""The Monte Carlo studies: how far a vehicle gets with little information."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.studies.town.settings import LandmarkStudy, RangeStudy
from crosscue.replay.base import UsageError, json_tree

if TYPE_CHECKING:
    import pyarrow as pa

    from crosscue.eval.studies.page import Table
    from crosscue.eval.studies.town.field_study import FieldRun
    from crosscue.eval.studies.town.settings import FieldStudy
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

    @property
    def page(self) -> Path:
        """The page with tables and figures."""
        from crosscue.eval.studies.town.whole import PAGE

        return self.folder / PAGE

    def as_dict(self) -> object:
        """What ``crosscue study range --json`` prints: the summary in its folder."""
        from crosscue.eval.studies.town.whole import SUMMARY

        return json_tree((self.folder / SUMMARY).read_text(encoding="utf-8"))

    def __repr__(self) -> str:
        tables = "\n\n".join(table.as_text() for table in self.made.tables)
        return "\n".join([tables, "", *self.made.notes])


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FieldResult:
    """The field protocol, simulated; printed as its tables beside the published ones.

    Attributes:
        folder: Where runs, picture and page are.
        runs: The outcome of each run.
        tables: Results in words.
        notes: What to know when reading them.
    """

    folder: Path
    runs: tuple[FieldRun, ...]
    tables: tuple[Table, ...]
    notes: tuple[str, ...]

    @property
    def page(self) -> Path:
        """The page with tables and picture."""
        from crosscue.eval.studies.town.field_study import PAGE

        return self.folder / PAGE

    @property
    def is_whole(self) -> bool:
        """Nothing of any run's log was dropped."""
        return all(one.is_whole for one in self.runs)

    def as_dict(self) -> list[dict[str, object]]:
        """What ``crosscue study field --json`` prints: a record for each run."""
        return [asdict(one) for one in self.runs]

    def __repr__(self) -> str:
        tables = "\n\n".join(table.as_text() for table in self.tables)
        return "\n".join([tables, "", *self.notes])


def run_study(
    study: RangeStudy | LandmarkStudy,
    output: Path | str,
    workers: int | None = None,
    *,
    ray: str | None = None,
    overwrite: bool = False,
    on_percent: Callable[[float, float], None] = lambda done, of: None,
) -> StudyResult:
    """Drive a study and summarise it; an interrupted one goes on where it stopped.

    Args:
        study: ``RangeStudy()`` or ``LandmarkStudy()``, its fields changed as wanted.
        output: Folder for drives, figures and page.
        workers: Cores; all, if left out.
        ray: Address of a Ray cluster to drive on.
        overwrite: Replace another study's results.
        on_percent: Called with the percentage that is done, and 100.

    Raises:
        RunError: The folder holds another study's results.
    """
    from crosscue.eval.studies.town.whole import drive_study, finish_landmarks, finish_range
    from crosscue.eval.studies.town.work import default_workers

    folder = Path(output)
    count = workers or default_workers()
    for done in drive_study(study, folder, count, ray, overwrite=overwrite):
        on_percent(100.0 * done, 100.0)
    if isinstance(study, RangeStudy):
        return StudyResult(study, finish_range(study, folder))
    return StudyResult(study, finish_landmarks(study, folder))


def run_field_study(
    study: FieldStudy,
    output: Path | str,
    workers: int | None = None,
    *,
    overwrite: bool = False,
    on_percent: Callable[[float, float], None] = lambda done, of: None,
) -> FieldResult:
    """Drive the field protocol through logs and the replay; an interrupted one goes on.

    Args:
        study: ``FieldStudy()``, its fields changed as wanted.
        output: Folder for runs, picture and page.
        workers: Cores; all, if left out.
        overwrite: Replace another study's results.
        on_percent: Called with the percentage that is done, and 100.

    Raises:
        UsageError: A study without runs.
        RunError: The folder holds another study's results.
    """
    from crosscue.eval.studies.town.field_study import NOTES, drive_field, finish_field
    from crosscue.eval.studies.town.replayed import through_log
    from crosscue.eval.studies.town.work import default_workers

    if not study.range_runs + study.landmark_runs:
        raise UsageError("study field: no runs; give --range-runs or --landmark-runs")
    folder, runs = Path(output), []
    driven = drive_field(
        study, folder, workers or default_workers(), through_log, overwrite=overwrite
    )
    for done, one in driven:
        runs.append(one)
        on_percent(100.0 * done, 100.0)
    return FieldResult(folder, tuple(runs), finish_field(study, runs, folder), tuple(NOTES))


def calibrate_study(study: RangeStudy, workers: int | None = None) -> float:
    """The compass interval with which a study's vehicles are lost after the published mean.

    Args:
        study: Everything but the compass; seeds of their own are driven.
        workers: Cores; all, if left out.

    Returns:
        Metres between two independent readings.
    """
    from crosscue.eval.studies.town.range_study import calibrate
    from crosscue.eval.studies.town.work import default_workers

    return calibrate(study.drive, workers or default_workers())
