"""Run a study from its settings: drives, summary, pictures, page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from crosscue.eval.runs.folder import RunFolder, locked
from crosscue.eval.studies.page import Table, write_page
from crosscue.eval.studies.words import km, percent
from crosscue.localization.town.drive import Result
from crosscue.replay.base import RunError, door, json_tree, strict_json, write_text

from . import landmark_figure, landmark_study, range_figure, range_study
from .cases import split
from .settings import LandmarkStudy, RangeStudy
from .work import DRIVES, assemble, chunks_of, run

SUMMARY: Final = "summary.json"
PAGE: Final = "study.html"
OURS: Final = (
    "Everything here is simulated. The dissertation specifies the sizes of cities, the compasses "
    "and the limits of 50 and 100 m; every other number is our choice and is in summary.json. One "
    "of them, the distance between compass readings with independent errors, was calibrated to "
    "the published 9.3 km at 30 degrees, on seeds that are not reported; the rest are predictions."
)


@dataclass(frozen=True, slots=True)
class Made:
    """Results of a finished study.

    Attributes:
        folder: Its folder.
        tables: Results as text.
        notes: Notes on the results.
    """

    folder: Path
    tables: tuple[Table, ...]
    notes: tuple[str, ...]


def drive_study(
    study: RangeStudy | LandmarkStudy,
    folder: Path,
    workers: int,
    ray_address: str | None = None,
    *,
    overwrite: bool = False,
) -> Iterator[float]:
    """Simulate all drives of a study, and yield the fraction done.

    Raises:
        RunError: The folder contains another study's results and ``overwrite`` is not set, or
            another process is writing to it.
        WorkerError: As in ``work.run``.
    """
    _refuse_another(study, folder, overwrite=overwrite)
    folder.mkdir(parents=True, exist_ok=True)
    with locked(RunFolder(folder)):
        chunks = chunks_of(study.cases(), study.drives, study.seed)
        for done in run(chunks, folder, workers, ray_address):
            yield done / len(chunks)
        assemble(chunks, folder)


def finish_range(study: RangeStudy, folder: Path) -> Made:
    """Write summary, picture and page from ``drives.parquet``."""
    table = RunFolder(folder).table(DRIVES)
    results = range_study.summarise(study, table)
    picture = range_figure.draw(
        results, list(split(table)), study.drive.navigation.lost_above_m, folder
    )
    others = range_study.drive_choices(study)
    return _finish(
        study,
        folder,
        "Range without landmarks",
        [asdict(r) for r in results],
        (*range_tables(results), choices_table(others)),
        (OURS, *RANGE_NOTES),
        [picture, range_figure.draw_choices(others, folder)],
        choices=[range_study.choice_tree(one) for one in others],
    )


def finish_landmarks(study: LandmarkStudy, folder: Path) -> Made:
    """Write summary, pictures and page from ``drives.parquet``."""
    table = RunFolder(folder).table(DRIVES)
    result = landmark_study.summarise(study, table)
    pictures = landmark_figure.draw(study, result, list(split(table)), folder)
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


def range_tables(results: Sequence[range_study.CompassResult]) -> tuple[Table, ...]:
    """Return the results by compass, with the published ones."""
    return (
        Table(
            "Distance at loss (95 % intervals)",
            (
                "compass",
                "drives",
                "lost",
                "mean, km",
                "published, km",
                "shortest..longest",
                "curve at 100 m",
                "r ds D",
                "NEES (consistent)",
            ),
            tuple(
                (
                    range_figure.name_of(r),
                    str(r.drives),
                    percent(r.fraction_lost),
                    km(r.lost_after_m) if r.lost else "never lost",
                    _published(r),
                    f"{r.shortest_m / 1e3:.2f}..{r.longest_m / 1e3:.2f}" if r.lost else "",
                    km(r.growth.crossing_m),
                    "" if math.isnan(r.law_m) else f"{r.law_m / 1e3:.1f}",
                    f"{r.nees_mean:.2f} ({r.nees_band[0]:.2f}..{r.nees_band[1]:.2f})",
                )
                for r in results
            ),
        ),
    )


def choices_table(choices: Sequence[range_study.Choice]) -> Table:
    """Return every choice, with the published numbers."""
    published = [
        f"{range_study.PUBLISHED_M[c] / 1e3:.1f} published"
        for c in (range_study.CALIBRATED_DEG, *range_study.PREDICTED)
    ]
    return Table(
        f"Mean distance at loss with other choices, km ({choices[0].drives} drives each)",
        (
            "slip, m per root m",
            "compass interval, m",
            f"30 degrees, {published[0]}",
            f"20 degrees, {published[1]}",
            f"none, {published[2]}",
        ),
        tuple(
            (
                f"{one.slip_per_sqrt_m:g}",
                f"{one.compass_interval_m:.3f}" + (" (studied)" if one.is_studied else ""),
                *(
                    km(one.lost_after_m[c])
                    for c in (range_study.CALIBRATED_DEG, *range_study.PREDICTED)
                ),
            )
            for one in choices
        ),
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
    tables: tuple[Table, ...],
    notes: tuple[str, ...],
    pictures: Sequence[Path],
    **more: object,
) -> Made:
    summary = {
        "study": study.model_dump(mode="json"),
        "notes": notes,
        "results": results,
        **more,
        "columns": ["case", "drive", "seed", *Result._fields],
    }
    write_page(folder / PAGE, f"{title}: simulated study", notes, tables, pictures)
    write_text(folder / SUMMARY, strict_json(summary) + "\n")
    return Made(folder, tables, notes)


def _refuse_another(study: RangeStudy | LandmarkStudy, folder: Path, *, overwrite: bool) -> None:
    path = folder / SUMMARY
    if overwrite or not path.exists():
        return
    try:
        before = json_tree(door.read(path))["study"]
    except (OSError, ValueError, KeyError, TypeError):
        before = None
    if before != study.model_dump(mode="json"):
        raise RunError(
            f"{folder}: contains a study with other settings; use another folder or --overwrite"
        )
