"""Run the Monte Carlo studies of navigation with little information."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.studies.town.settings import LandmarkStudy, RangeStudy
from crosscue.replay.base import UsageError, door, json_tree

if TYPE_CHECKING:
    import pyarrow as pa

    from crosscue.eval.studies.page import Table
    from crosscue.eval.studies.town.field_study import FieldRun
    from crosscue.eval.studies.town.run import Made
    from crosscue.eval.studies.town.settings import FieldStudy


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StudyResult:
    """A finished study; its repr is tables with the published numbers.

    Attributes:
        study: Settings of the study.
        made: Folder, tables as text, and notes on them.
    """

    study: RangeStudy | LandmarkStudy
    made: Made

    @property
    def folder(self) -> Path:
        """Folder of drives, figures and page."""
        return self.made.folder

    @property
    def drives(self) -> pa.Table:
        """Table with one row per drive."""
        return RunFolder(self.folder).table("drives")

    def draw_drive(self, row: int) -> Path:
        """Draw the drive of a row of ``drives``; return the picture in the study's folder."""
        from crosscue.eval.studies.town import drive_figure
        from crosscue.localization.town.drive import drive_traced

        drives = self.drives
        settings = self.study.cases()[drives["case"][row].as_py()].settings
        seed = drives["seed"][row].as_py()
        return drive_figure.draw(settings, drive_traced(settings, seed), seed, self.folder)

    @property
    def page(self) -> Path:
        """The page with tables and figures."""
        from crosscue.eval.studies.town.run import PAGE

        return self.folder / PAGE

    def as_dict(self) -> object:
        """Return the JSON output of ``crosscue study range``: the summary in its folder."""
        from crosscue.eval.studies.town.run import SUMMARY

        return json_tree(door.read(self.folder / SUMMARY))

    def __repr__(self) -> str:
        tables = "\n\n".join(table.as_text() for table in self.made.tables)
        return "\n".join([tables, "", *self.made.notes])


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FieldResult:
    """Results of the simulated field protocol; its repr is tables with the published numbers.

    Attributes:
        folder: Folder of runs, picture and page.
        runs: Outcome of each run.
        tables: Results as text.
        notes: Notes on the results.
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
        """True if nothing of any run's log was dropped."""
        return all(one.is_whole for one in self.runs)

    def as_dict(self) -> list[dict[str, object]]:
        """Return the JSON output of ``crosscue study field``: a record for each run."""
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
    """Run and summarise a study; an interrupted study continues where it stopped.

    Args:
        study: ``RangeStudy()`` or ``LandmarkStudy()``, with any fields changed.
        output: Folder for drives, figures and page.
        workers: Number of cores; default: all.
        ray: Address of a Ray cluster to run on.
        overwrite: Replace another study's results.
        on_percent: Called with the percentage done, and 100.

    Raises:
        RunError: The folder contains another study's results.
    """
    from crosscue.eval.studies.town.run import drive_study, finish_landmarks, finish_range
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
    """Simulate the field protocol with logs and replays; an interrupted study continues.

    Args:
        study: ``FieldStudy()``, with any fields changed.
        output: Folder for runs, picture and page.
        workers: Number of cores; default: all.
        overwrite: Replace another study's results.
        on_percent: Called with the percentage done, and 100.

    Raises:
        UsageError: The study has no runs.
        RunError: The folder contains another study's results.
    """
    from crosscue.eval.studies.town.field_study import NOTES, drive_field, finish_field
    from crosscue.eval.studies.town.replayed import through_log
    from crosscue.eval.studies.town.work import default_workers

    if not study.range_runs + study.landmark_runs:
        raise UsageError("study field: no runs; set --range-runs or --landmark-runs")
    folder, runs = Path(output), []
    driven = drive_field(
        study, folder, workers or default_workers(), through_log, overwrite=overwrite
    )
    for done, one in driven:
        runs.append(one)
        on_percent(100.0 * done, 100.0)
    return FieldResult(folder, tuple(runs), finish_field(study, runs, folder), tuple(NOTES))


def calibrate_study(study: RangeStudy, workers: int | None = None) -> float:
    """Find the compass interval with which the mean range equals the published one.

    Args:
        study: Settings of the study, apart from the compass; separate seeds are used.
        workers: Number of cores; default: all.

    Returns:
        Distance between two independent readings, metres.
    """
    from crosscue.eval.studies.town.range_study import calibrate
    from crosscue.eval.studies.town.work import default_workers

    return calibrate(study.drive, workers or default_workers())
