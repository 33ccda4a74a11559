"""A study from settings to its folder: drives, summary, pictures, page."""

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
from crosscue.replay.base import RunError, json_tree, strict_json, write_text

from . import landmark_figure, landmark_study, range_figure, range_study
from .cases import split
from .settings import LandmarkStudy, RangeStudy
from .work import DRIVES, assemble, chunks_of, run

SUMMARY: Final = "summary.json"
PAGE: Final = "study.html"
OURS: Final = (
    "Everything here is simulated. The source fixes the sizes of cities, the compasses and the "
    "limits of 50 and 100 m; every other number is ours and stands in summary.json. One of them, "
    "the distance between compass readings with errors of their own, was calibrated to the "
    "published 9.3 km at 30 degrees, on seeds that are not reported; all else are predictions."
)


@dataclass(frozen=True, slots=True)
class Made:
    """What a study left behind.

    Attributes:
        folder: Its folder.
        tables: Results in words.
        notes: What to know when reading them.
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
    """Drive all drives of a study into ``folder``; the fraction done comes as it grows.

    Raises:
        RunError: The folder holds another study's results, and ``overwrite`` is not given; or
            another process works in it.
        WorkerError: As ``work.run``.
    """
    _refuse_another(study, folder, overwrite=overwrite)
    folder.mkdir(parents=True, exist_ok=True)
    with locked(RunFolder(folder)):
        chunks = chunks_of(study.cases(), study.drives, study.seed)
        for done in run(chunks, folder, workers, ray_address):
            yield done / len(chunks)
        assemble(chunks, folder)


def finish_range(study: RangeStudy, folder: Path) -> Made:
    """Summary, picture and page from ``drives.parquet``."""
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
    """Summary, pictures and page from ``drives.parquet``."""
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
    f"How the calibrated number was chosen: study range --calibrate drives "
    f"{range_study.CALIBRATION_DRIVES:,} drives at 30 degrees on seeds of their own and scales the "
    "compass interval by their mean distance at loss over 9.3 km until both agree within 0.2 %. "
    "The slip of the wheels is ours and was fitted to nothing; several pairs of slip and interval "
    "reproduce the published 9.3 km, as the table of other choices shows.",
    f"The published means follow the law of 1 / r: at 25 degrees they imply "
    f"{range_study.implied_m(20.0, 25.0) / 1e3:.1f} km (from 20 degrees) or "
    f"{range_study.implied_m(30.0, 25.0) / 1e3:.1f} km (from 30), where the field runs are said to "
    "have reached nearly 10 km.",
    "Drives go on from goal to goal until lost or 60 km; the source drove to one goal each and "
    "says neither how it averaged nor how it came to 20.8 km, farther than nearly all of its goals "
    "can have been.",
    "r ds D: the distance at which a car driving straight on would be lost; turns spread the "
    "variance over two axes and lengthen it.",
    "NEES: squared error of x, y, heading in units of the covariance claimed, 3 where honest. "
    "Without a compass the filter is too sure: after a heading error of 5 degrees the true "
    "positions lie on an arc, its ellipse is straight. With one it is too sure by a few per cent, "
    "at 10 degrees because it does not know of the steps of the wheels' encoders "
    "(docs/studies.md).",
)


def range_tables(results: Sequence[range_study.CompassResult]) -> tuple[Table, ...]:
    """Results by compass, beside the published ones."""
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
                "NEES (honest)",
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
    """Every choice beside the published figures."""
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
        before = json_tree(path.read_text(encoding="utf-8"))["study"]
    except (OSError, ValueError, KeyError, TypeError):
        before = None
    if before != study.model_dump(mode="json"):
        raise RunError(
            f"{folder}: holds a study with other settings; give another folder or --overwrite"
        )
