"""Fit beliefs to random layouts, with and without intersections, and test them on others."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Final, NamedTuple

from crosscue.datasets.scenes.drive import Imager
from crosscue.datasets.scenes.faulty_labels import DETECTORS, LABEL_IMAGES
from crosscue.eval.batch.jobs import JobOutcome, exit_status_of
from crosscue.eval.batch.ray_jobs import engine_of
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.scoring.intervals import TOO_FEW, Mean
from crosscue.eval.studies.pictures import save_png
from crosscue.eval.studies.simulated_drives import SPARSE_AND_EMBEDDED, run_drives
from crosscue.eval.studies.study import PageTable, StudyResult, Written, without_nan
from crosscue.replay.errors import RunError
from crosscue.replay.versions import versions
from crosscue.results import HIDDEN
from crosscue.verb import Option

from .score import LayoutDifference, LayoutScore, LayoutScores
from .settings import LayoutStudy, Perception
from .study import open_study_drive, score_layout_study

TITLE: Final = "Random layouts, simulated: fitted on some, tested on the others"
FIGURE: Final = "trade_off.png"
SCORES: Final = ("Brier", "log score", "false a drive", "full", "full, m")
DIFFERENCES: Final = ("left out or compared", "Brier", "by it", "log score", "false a drive")


class _Perceived(NamedTuple):
    """Source of the pictures, detectors, and what the page says of them."""

    imager: Imager
    detectors: str
    note: str


PERCEPTION: Final[Mapping[Perception, _Perceived]] = {
    "pixels": _Perceived(
        *SPARSE_AND_EMBEDDED,
        "Everything here is simulated. The embedded networks saw rendered photographs; they were "
        "trained on other layouts of the same renderer. Intervals are 95 %, over layouts.",
    ),
    "faults": _Perceived(
        LABEL_IMAGES,
        DETECTORS,
        "Everything here is simulated. No network saw a picture: masks are the renderer's, with "
        "misses, false detections and errors of height drawn from settings that are not measured. "
        "Intervals are 95 %, over layouts.",
    ),
}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LayoutResult(StudyResult):
    """Scores of beliefs on layouts that they were not fitted to; its repr is tables.

    Attributes:
        scores: Scores of each belief, and of its ablations of cues and rules.
        drives: Outcome of each drive.
    """

    scores: LayoutScores = field(metadata=HIDDEN)
    drives: tuple[JobOutcome[Outcome], ...] = field(metadata=HIDDEN)

    @property
    def exit_status(self) -> int:
        """0 if all drives are complete; 3 if a drive failed or something was dropped."""
        return exit_status_of(self.drives)


def run_layout_study(
    study: LayoutStudy,
    output: Path | str,
    *,
    workers: int = 1,
    ablation: Annotated[bool, Option("--no-ablation")] = True,
) -> LayoutResult:
    """Fit beliefs to random simulated layouts, and test them on other layouts.

    There are thirteen kinds of layouts, five of them without an intersection. Every drive is
    rendered and processed by the embedded networks, and each belief is scored on layouts that it
    was not fitted to. With --perception faults, no network runs: the renderer's masks are used,
    with simulated faults. Writes study.html and study.json. A second start processes only the
    missing drives.

    Example:
        crosscue study layouts -o layouts --workers 2

    Args:
        study: Settings of the study.
        output: Folder for drives, runs, tables and page.
        workers: Number of drives in parallel.
        ablation: Skip the ablation of cues and rules.

    Raises:
        UsageError: ``workers`` is below 1.
        RunError: All drives of a fold failed.
        OutputError: A file cannot be written.
    """
    folder, perceived = Path(output), PERCEPTION[study.perception]
    scenes, engine = study.scenes(), engine_of(workers, None)
    done = run_drives(folder, scenes, perceived.detectors, engine, imager=perceived.imager)
    failures = {one.job.name: one.error for one in done if one.error is not None}
    drives = [open_study_drive(folder, study, one) for one in scenes if one.name not in failures]
    if len({one.fold for one in drives}) < study.folds:
        first = next(iter(failures.items()))
        raise RunError(f"{folder}: all drives of a fold failed; the first: {': '.join(first)}")
    scores = score_layout_study(drives, ablation=ablation)
    written = write_layout_study(folder, study, scores, failures)
    return LayoutResult(folder, written.tables, written.notes, scores, done)


def write_layout_study(
    folder: Path, study: LayoutStudy, scores: LayoutScores, failures: Mapping[str, str]
) -> Written:
    """Write figure, page and tables to ``folder``.

    Raises:
        OutputError: A file cannot be written.
    """
    flags = (
        f"--perception {study.perception} --blocks {study.blocks} --runs {study.runs} "
        f"--folds {study.folds} --seed {study.seed} --layouts-from {study.layouts_from} "
        f"--width {study.width_px}"
    )
    content = {
        "is_simulated": True,
        "perception": study.perception,
        "command": f"crosscue study layouts {flags}",
        "versions": versions(),
        "failures": dict(failures),
        **without_nan(asdict(scores)),
    }
    notes = [
        PERCEPTION[study.perception].note,
        f"{scores.drives} drives over {scores.layouts} layouts in {study.folds} folds.",
        *(f"failed {name}: {why}" for name, why in failures.items()),
    ]
    draw_trade_off(scores.kinds, folder / FIGURE)
    written = Written(TITLE, notes, study_tables(scores), content, [folder / FIGURE])
    written.write(folder, "study.json")
    return written


def study_tables(scores: LayoutScores) -> list[PageTable]:
    """Return all tables, for the page and for a terminal."""
    kinds, first = scores.kinds, next(iter(scores.kinds.values()))
    found = [
        _scored("Beliefs", "belief", kinds),
        PageTable(
            "Fully detected, by false features a drive; each belief with its own threshold",
            ("belief", *(f"{one.wanted:g}" for one in first.trade)),
            tuple(
                (kind, *(f"{text(p.full, 2)} at {p.threshold:.4g}" for p in one.trade))
                for kind, one in kinds.items()
            ),
        ),
        PageTable(
            "Brier score by feature",
            ("belief", *first.brier_by_feature),
            tuple((kind, *map(text, one.brier_by_feature.values())) for kind, one in kinds.items()),
        ),
        _compared("Belief over time less others", scores.less),
        PageTable(
            "Law and coverage, fractions of pictures",
            ("belief", "a way before the intersection", "no approach open"),
            tuple(
                (kind, text(one.full_before_detected), text(one.silent))
                for kind, one in kinds.items()
            ),
        ),
        _compared(
            "Each cue left out of the belief over time in every picture, without less with",
            scores.cues,
        ),
        _scored("Rules for real roads, each left out", "left out", scores.rules),
        _compared("Rules for real roads, without less with", scores.rules_less),
    ]
    return [table for table in found if table.rows]


def _scored(heading: str, what: str, some: Mapping[str, LayoutScore]) -> PageTable:
    rows = [
        (
            name or "none",
            *map(text, (one.brier, one.log_score, one.false_features, one.full)),
            text(one.full_m, 1),
        )
        for name, one in some.items()
    ]
    return PageTable(heading, (what, *SCORES), tuple(rows))


def _compared(heading: str, some: Mapping[str, LayoutDifference]) -> PageTable:
    rows = [
        (
            name,
            text(one.brier, signed=True),
            verdict(one.brier),
            *(text(value, signed=True) for value in (one.log_score, one.false_features)),
        )
        for name, one in some.items()
    ]
    return PageTable(heading, DIFFERENCES, tuple(rows))


def verdict(less: Mean) -> str:
    """Return the verdict of a difference: undecided if its interval contains zero or is missing."""
    return "better" if less.high < 0.0 else "worse" if less.low > 0.0 else "undecided"


def text(value: Mean, digits: int = 3, *, signed: bool = False) -> str:
    """Return a mean with its interval as text."""
    if math.isnan(value.value):
        return "-"
    shown = f"{{:{'+' if signed else ''}.{digits}f}}".format
    if math.isnan(value.low):
        return f"{shown(value.value)} ({TOO_FEW})"
    return f"{shown(value.value)} ({shown(value.low)} to {shown(value.high)})"


def draw_trade_off(kinds: Mapping[str, LayoutScore], path: Path) -> None:
    """Draw full detection of each belief at the same rates of false features, with intervals.

    Raises:
        OutputError: The file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    for number, (kind, score) in enumerate(kinds.items()):
        full = [one.full for one in score.trade]
        axes.errorbar(
            [one.wanted + 0.002 * number for one in score.trade],
            [one.value for one in full],
            yerr=[
                [max(one.value - one.low, 0.0) for one in full],
                [max(one.high - one.value, 0.0) for one in full],
            ],
            label=kind,
            lw=1.0,
            elinewidth=0.4,
            marker="o",
            ms=3,
        )
    axes.set_xlabel("false features a drive, at most (simulated)", fontsize=8)
    axes.set_ylabel("fraction fully detected", fontsize=8)
    axes.set_ylim(-0.02, 1.02)
    axes.tick_params(labelsize=7)
    axes.legend(fontsize=7)
    save_png(figure, path)
