"""Write the study's files: metrics as JSON, figures, and a page with the tables."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from crosscue.eval.batch.jobs import JobOutcome
from crosscue.eval.failures.causes import Finding, approach_findings, by_cause
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.report.html import write_page
from crosscue.eval.report.scene_figures import PUBLISHED_DETECTED_M, PUBLISHED_FULL_M
from crosscue.eval.scoring.files import write_scores
from crosscue.eval.scoring.intervals import TOO_FEW
from crosscue.eval.scoring.runs import RunScored, metrics_of
from crosscue.eval.scoring.scene.approaches import ApproachScore
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.versions import versions

from .conditions import condition_costs
from .contact_sheet import write_sheet
from .figures import draw_beliefs, draw_study_distances, draw_study_reliability
from .settings import IntersectionStudy
from .tables import (
    StudyScores,
    attribution_rows,
    cue_rows,
    intersection_rows,
    mean_text,
    quoted_rows,
)

PAGE: Final = "study.html"
TEMPLATE: Final = "intersections.html.j2"
TABLES: Final = "study.json"
SHEET: Final = "detections.jpg"


@dataclass(frozen=True, slots=True)
class StudyFiles:
    """The written files."""

    page: Path
    tables: Path
    metrics: Path
    sheet: Path


def write_study(
    out: Path, settings: IntersectionStudy, done: Sequence[JobOutcome[Outcome]], scored: StudyScores
) -> StudyFiles:
    """Write metrics, tables, figures and page to ``out``.

    Raises:
        OutputError: A file cannot be written.
    """
    approaches = scored.scores.approaches
    assert approaches is not None
    folder = out / "score"
    metrics = metrics_of(scored.scored, scored.scores)
    write_scores(folder, scored.scored, metrics)
    found = _findings(scored.scored)
    tables = _tables(settings, done, scored, approaches, found)
    write_text(out / TABLES, strict_json(tables) + "\n")
    content = {
        **tables,
        "coverage": metrics["coverage"],
        "approaches": approaches,
        "belief": scored.scores.belief,
        "range": scored.scores.range,
        "difference": scored.difference,
        "calibrated": None if scored.calibrated is None else scored.calibrated.approaches,
        "figures": _figures(out, scored, approaches),
    }
    write_page(
        out / PAGE,
        TEMPLATE,
        content,
        {"number": _number, "signed": _signed, "between": _between},
    )
    write_sheet(scored.scored, out / SHEET)
    return StudyFiles(out / PAGE, out / TABLES, folder / "metrics.json", out / SHEET)


def _tables(
    settings: IntersectionStudy,
    done: Sequence[JobOutcome[Outcome]],
    scored: StudyScores,
    approaches: ApproachScore,
    found: Sequence[Finding],
) -> dict[str, Any]:
    learned = None if scored.calibrated is None else scored.calibrated.approaches
    flags = f"--runs {settings.runs} --seed {settings.seed} --width {settings.width_px}"
    return {
        "is_simulated": True,
        "wanted": len(done),
        "done": len(scored.scored),
        "failed": sum(one.error is not None for one in done),
        "failures": [f"{one.job.name}: {one.error}" for one in done if one.error is not None],
        "seed": settings.seed,
        "command": f"crosscue study intersections {flags}",
        "versions": versions(),
        "published": {"detected_m": PUBLISHED_DETECTED_M, "full_m": PUBLISHED_FULL_M},
        "detected_m": mean_text(approaches.detected_m),
        "full_m": mean_text(approaches.full_m),
        "calibrated_detected_m": "" if learned is None else mean_text(learned.detected_m),
        "calibrated_full_m": "" if learned is None else mean_text(learned.full_m),
        "intersections": intersection_rows(approaches.results),
        "findings": [asdict(one) for one in found],
        "causes": by_cause(found),
        "conditions": [asdict(one) for one in condition_costs(approaches.results)],
        "quoted": quoted_rows(scored),
        "cues": cue_rows(scored.scores.cues),
        "attribution": attribution_rows(scored),
        "calibrated_less_source": {
            feature: asdict(difference) for feature, difference in scored.difference.items()
        },
    }


def _figures(out: Path, scored: StudyScores, approaches: ApproachScore) -> dict[str, str]:
    paths = {name: out / f"{name}.png" for name in ("distances", "beliefs", "reliability")}
    draw_study_distances(approaches.results, paths["distances"])
    curves = [
        curve
        for one in scored.scored
        if one.judged.approaches is not None
        for curve in one.judged.approaches.curves
    ]
    draw_beliefs(curves, paths["beliefs"])
    learned = None if scored.calibrated is None else scored.calibrated.belief
    draw_study_reliability(scored.scores.belief, learned, paths["reliability"])
    return {
        name: f"data:image/png;base64,{base64.b64encode(door.read(path)).decode()}"
        for name, path in paths.items()
    }


def _number(value: float | None, digits: int = 1) -> str:
    return "never" if value is None else "-" if math.isnan(value) else f"{value:.{digits}f}"


def _signed(value: float | None, digits: int = 0) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:+.{digits}f}"


def study_text(
    done: Sequence[JobOutcome[Outcome]], scored: StudyScores, written: StudyFiles
) -> str:
    """Return a text summary of the study, within 80 columns."""
    approaches = scored.scores.approaches
    assert approaches is not None
    failed = [one for one in done if one.error is not None]
    wrong = approaches.false_features
    lines = [
        f"simulated drives   {len(scored.scored)} of {len(done)} done, {len(failed)} failed",
        *(f"  failed           {one.job.name}: {one.error}" for one in failed),
        f"detected           {_of(approaches.detected.right, approaches.detected.of)} at "
        f"{mean_text(approaches.detected_m)}; published 34.4 m",
        f"full intersection  {_of(approaches.full.right, approaches.full.of)} at "
        f"{mean_text(approaches.full_m)}; published 16.2 m, 76 of 80",
        f"false features     in {_of(wrong.right, wrong.of)}",
        "",
        f"{'intersection':<14}{'detected':>12}{'mean':>9}{'full':>12}{'mean':>9}",
    ]
    for row in intersection_rows(approaches.results):
        lines.append(
            f"{row['intersection']:<14}{_of(row['detected'], row['approaches']):>12}"
            f"{_number(row['detected_m']):>9}{_of(row['full'], row['approaches']):>12}"
            f"{_number(row['full_m']):>9}"
        )
    lines += ["", "late, missing or invented (drives):"]
    for cause, places in by_cause(_findings(scored.scored)).items():
        reported_places = ", ".join(f"{place} {drives}" for place, drives in places.items())
        lines.append(f"  {cause:<20} {reported_places}")
    lines += ["", f"{'cue':<20}{'precision':>10}{'95 %':>16}{'positives':>11}{'published':>11}"]
    for row in cue_rows(scored.scores.cues):
        ends = f"{_number(row['wilson_low'], 2)} to {_number(row['wilson_high'], 2)}"
        lines.append(
            f"{row['cue']:<20}{_number(row['precision'], 2):>10}{ends:>16}"
            f"{row['positives']:>11,}{row['published']:>11.2f}"
        )
    lines += [
        "",
        f"page       {written.page}",
        f"tables     {written.tables}",
        f"pictures   {written.sheet}: a frame of each drive, with detections",
    ]
    return "\n".join(lines)


def _between(mean: Mapping[str, Any], digits: int = 1) -> str:
    """Return a difference with its interval as text, from the result of ``asdict``."""
    value, low, high = mean["value"], mean["low"], mean["high"]
    if math.isnan(value):
        return "-"
    if math.isnan(low):
        return f"{value:+.{digits}f} ({TOO_FEW})"
    return f"{value:+.{digits}f} ({low:+.{digits}f} to {high:+.{digits}f})"


def _of(some: int, of: int) -> str:
    return f"{some} of {of}"


def _findings(scored: Sequence[RunScored]) -> tuple[Finding, ...]:
    """Return all late, missing and false features, drive by drive."""
    return tuple(
        found
        for one in scored
        if one.judged.approaches is not None
        for result in one.judged.approaches.results
        for found in approach_findings(result, one.judged.cues)
    )
