"""Run a study from its settings: drives, summary, pictures, page."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, overload

import pyarrow as pa

from crosscue.eval.runs.folder import RunFolder, locked
from crosscue.eval.studies.intervals import km, percent
from crosscue.eval.studies.study import PageTable, StudyResult, Written, claim
from crosscue.localization.town.drive import DriveResult, drive_traced
from crosscue.replay.progress import Progress, emit
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option

from . import drive_figure, landmark_study, range_study
from .settings import LandmarkStudy, RangeStudy, drives_of
from .work import DRIVES, chunks_of, run, split, workers_of

SUMMARY: Final = "summary.json"
OURS: Final = (
    "Everything here is simulated. The dissertation specifies the sizes of cities, the compasses "
    "and the limits of 50 and 100 m; every other number is our choice and is in summary.json. One "
    "of them, the distance between compass readings with independent errors, was calibrated to "
    "the published 9.3 km at 30 degrees, on seeds that are not reported; the rest are predictions."
)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class TownResult(StudyResult):
    """A finished study of chapter 2.

    Attributes:
        study: Settings of the study.
    """

    study: RangeStudy | LandmarkStudy = field(metadata=HIDDEN)

    files: ClassVar = {SUMMARY: "summary", f"{DRIVES}.parquet": "drives"}

    @property
    def drives(self) -> pa.Table:
        """Table with one row per drive."""
        return RunFolder(self.folder).table(DRIVES)

    def draw_drive(self, row: int) -> Path:
        """Draw the drive of a row of ``drives``; return the picture in the study's folder."""
        drives = self.drives
        settings = self.study.cases()[drives["case"][row].as_py()].settings
        seed = drives["seed"][row].as_py()
        return drive_figure.draw_drive(settings, drive_traced(settings, seed), seed, self.folder)


@dataclass(frozen=True, slots=True, repr=False)
class Calibration(Result):
    """The compass interval with which the mean range equals the published one.

    Attributes:
        compass_interval_m: Distance between two independent readings.
    """

    compass_interval_m: float

    def lines(self) -> Iterator[str]:
        """Yield the setting of the simulated sensors."""
        yield f"compass_interval_m = {self.compass_interval_m:.4f}"


@overload
def run_range_study(
    study: RangeStudy,
    output: Path | str = ...,
    *,
    workers: int | None = None,
    overwrite: bool = False,
) -> TownResult: ...
@overload
def run_range_study(
    study: RangeStudy, *, workers: int | None = None, calibrate: Literal[True]
) -> Calibration: ...
def run_range_study(
    study: Annotated[RangeStudy, Option(made_by=drives_of(RangeStudy))],
    output: Path | str = "study-range",
    *,
    workers: int | None = None,
    overwrite: bool = False,
    calibrate: bool = False,
) -> TownResult | Calibration:
    """Measure the range without landmarks on 4,000 simulated drives.

    There are drives with three compasses and with none. Each goes from goal to goal until its
    2-sigma ellipse is longer than 100 m. Results are shown next to the published ones. The result
    does not depend on the number of workers.

    Examples:
        crosscue study range -o range
        crosscue study range --drives 50 --workers 2
        crosscue study range --calibrate

    Args:
        study: Settings of the study.
        output: Folder for drives, summary, figures and page.
        workers: Number of threads (default: all cores).
        overwrite: Replace existing results of another study.
        calibrate: Find the compass interval that yields the published 9.3 km at 30 degrees, with
            separate seeds, instead of running the study.

    Raises:
        UsageError: A value is out of range.
        RunError: The folder contains another study's results.
    """
    if calibrate:
        return Calibration(range_study.calibrate(study.drive, workers_of(workers)))
    return _finished(study, Path(output), workers, finish_range, overwrite=overwrite)


def run_landmark_study(
    study: Annotated[LandmarkStudy, Option(made_by=drives_of(LandmarkStudy))],
    output: Path | str = "study-landmarks",
    *,
    workers: int | None = None,
    overwrite: bool = False,
) -> TownResult:
    """Measure the success rate of 3 strategies with landmarks.

    The study has 52,500 drives, 700 for each of 5 landmark densities and 5 detection rates. It
    reports the success rate by distance to the goal, the range at 80 % success, and how much
    farther the strategies drive, next to the published numbers. The result does not depend on the
    number of workers.

    Examples:
        crosscue study landmarks -o landmarks
        crosscue study landmarks --drives 50 --workers 2

    Args:
        study: Settings of the study.
        output: Folder for drives, summary, figures and page.
        workers: Number of threads (default: all cores).
        overwrite: Replace existing results of another study.

    Raises:
        UsageError: A value is out of range.
        RunError: The folder contains another study's results.
    """
    return _finished(study, Path(output), workers, finish_landmarks, overwrite=overwrite)


def _finished(
    study: RangeStudy | LandmarkStudy,
    folder: Path,
    workers: int | None,
    finish: Callable[[Any, Path], Written],
    *,
    overwrite: bool,
) -> TownResult:
    for done in drive_study(study, folder, workers_of(workers), overwrite=overwrite):
        emit(Progress("driving", 100.0 * done, 100.0, "percent"))
    made = finish(study, folder)
    return TownResult(folder, made.tables, made.notes, study)


def drive_study(
    study: RangeStudy | LandmarkStudy, folder: Path, workers: int, *, overwrite: bool = False
) -> Iterator[float]:
    """Simulate all drives of a study, and yield the fraction done.

    Raises:
        RunError: The folder contains another study's results and ``overwrite`` is not set, or
            another process is writing to it.
        WorkerError: As in ``work.run``.
    """
    claim(folder / SUMMARY, study.model_dump(mode="json"), "study", overwrite=overwrite)
    with locked(RunFolder(folder)):
        chunks = chunks_of(study.cases(), study.drives, study.seed)
        for done in run(chunks, folder, workers):
            yield done / len(chunks)


def finish_range(study: RangeStudy, folder: Path) -> Written:
    """Write summary, picture and page from ``drives.parquet``."""
    rows = list(split(RunFolder(folder).table(DRIVES)))
    results = range_study.summarise_ranges(study, rows)
    picture = range_study.draw_range_study(
        results, rows, study.drive.navigation.lost_above_m, folder
    )
    others = range_study.drive_choices(study)
    return _finish(
        study,
        folder,
        "Range without landmarks",
        [asdict(r) for r in results],
        (range_table(results), choices_table(others)),
        (OURS, *RANGE_NOTES),
        [picture, range_study.draw_choices(others, folder)],
        choices=[range_study.choice_tree(one) for one in others],
    )


def finish_landmarks(study: LandmarkStudy, folder: Path) -> Written:
    """Write summary, pictures and page from ``drives.parquet``."""
    rows = list(split(RunFolder(folder).table(DRIVES)))
    result = landmark_study.summarise_landmarks(study, rows)
    pictures = landmark_study.draw_landmark_study(study, result, rows, folder)
    tables = landmark_study.tables(study, result)
    return _finish(
        study,
        folder,
        "Landmarks, strategies and detection rates",
        asdict(result),
        tables,
        (OURS, *landmark_study.NOTES),
        pictures,
    )


RANGE_NOTES: Final = (
    f"Choice of the calibrated number: study range --calibrate simulates "
    f"{range_study.CALIBRATION_DRIVES:,} drives at 30 degrees on separate seeds, and scales the "
    "compass interval by the ratio of their mean distance at loss to 9.3 km until both agree "
    "within 0.2 %. The slip of the wheels is our choice and was not fitted; several pairs of slip "
    "and interval reproduce the published 9.3 km, as the table of other choices shows.",
    f"The published means follow the law of 1 / r: at 25 degrees they imply "
    f"{range_study.implied_m(20.0, 25.0) / 1e3:.1f} km (from 20 degrees) or "
    f"{range_study.implied_m(30.0, 25.0) / 1e3:.1f} km (from 30), while the field runs are "
    "reported to have reached nearly 10 km.",
    "Drives continue from goal to goal until lost or 60 km. In the dissertation, each drive had "
    "one goal; neither the averaging nor the origin of 20.8 km, farther than nearly all of its "
    "goals can have been, is described.",
    "r ds D: the distance at which a car that drives straight is lost; turns spread the "
    "variance over two axes and lengthen it.",
    "NEES: squared error of x, y, heading, normalised by the covariance; 3 if consistent. Without "
    "a compass the filter is overconfident: after a heading error of 5 degrees, the true positions "
    "are on an arc, but its ellipse is straight. With a compass it is overconfident by a few per "
    "cent, at 10 degrees because it does not model the steps of the wheels' encoders "
    "(docs/studies.md).",
)


def range_table(results: Sequence[range_study.CompassResult]) -> PageTable:
    """Return the results by compass, with the published ones."""
    return PageTable.of(
        "Distance at loss (95 % intervals)",
        results,
        ("compass", range_study.compass_name),
        ("drives", lambda r: str(r.drives)),
        ("lost", lambda r: percent(r.fraction_lost)),
        ("mean, km", lambda r: km(r.lost_after_m) if r.lost else "never lost"),
        ("published, km", _published),
        (
            "shortest..longest",
            lambda r: f"{r.shortest_m / 1e3:.2f}..{r.longest_m / 1e3:.2f}" if r.lost else "",
        ),
        ("curve at 100 m", lambda r: km(r.growth.crossing_m)),
        ("r ds D", lambda r: "" if math.isnan(r.law_m) else f"{r.law_m / 1e3:.1f}"),
        (
            "NEES (consistent)",
            lambda r: f"{r.nees_mean:.2f} ({r.nees_band[0]:.2f}..{r.nees_band[1]:.2f})",
        ),
    )


def choices_table(choices: Sequence[range_study.CompassCase]) -> PageTable:
    """Return every choice, with the published numbers."""

    def lost_after(compass: float | None) -> tuple[str, Callable[[Any], str]]:
        name = "none" if compass is None else f"{compass:g} degrees"
        published_km = range_study.PUBLISHED_M[compass] / 1e3
        return (f"{name}, {published_km:.1f} published", lambda one: km(one.lost_after_m[compass]))

    return PageTable.of(
        f"Mean distance at loss with other choices, km ({choices[0].drives} drives each)",
        choices,
        ("slip, m per root m", lambda one: f"{one.slip_per_sqrt_m:g}"),
        (
            "compass interval, m",
            lambda one: f"{one.compass_interval_m:.3f}" + (" (studied)" if one.is_studied else ""),
        ),
        *map(lost_after, (range_study.CALIBRATED_DEG, *range_study.PREDICTED)),
    )


def _published(result: range_study.CompassResult) -> str:
    if math.isnan(result.published_m):
        return ""
    text = "never lost" if math.isinf(result.published_m) else f"{result.published_m / 1e3:.1f}"
    return text + (" (calibrated)" if result.is_calibrated else "")


def _finish(
    study: RangeStudy | LandmarkStudy,
    folder: Path,
    title: str,
    results: object,
    tables: tuple[PageTable, ...],
    notes: tuple[str, ...],
    pictures: Sequence[Path],
    **more: object,
) -> Written:
    summary = {
        "study": study.model_dump(mode="json"),
        "notes": notes,
        "results": results,
        **more,
        "columns": ["case", "drive", "seed", *DriveResult._fields],
    }
    made = Written(f"{title}: simulated study", notes, tables, summary, pictures)
    made.write(folder, SUMMARY)
    return made
