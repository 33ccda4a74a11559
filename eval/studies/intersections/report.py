"""Write the study's files: metrics as JSON, figures, and a page with the tables."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from crosscue.eval.batch.jobs import JobOutcome
from crosscue.eval.failures.causes import Finding, approach_findings, by_cause
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.report.html import write_page
from crosscue.eval.report.scene_figures import PUBLISHED_DETECTED_M, PUBLISHED_FULL_M
from crosscue.eval.scoring.files import write_scores
from crosscue.eval.scoring.intervals import TOO_FEW, Proportion
from crosscue.eval.scoring.runs import RunScored, metrics_of
from crosscue.eval.scoring.scene.approaches import ApproachScore
from crosscue.eval.studies.study import PAGE, PageTable
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.versions import versions

from .contact_sheet import write_sheet
from .figures import draw_beliefs, draw_study_distances, draw_study_reliability
from .settings import IntersectionStudy
from .tables import (
    StudyScores,
    attribution_rows,
    condition_costs,
    cue_rows,
    intersection_rows,
    mean_text,
    quoted_rows,
)

TEMPLATE: Final = "intersections.html.j2"
TABLES: Final = "study.json"
SHEET: Final = "detections.jpg"
CUES: Final = ("precision (Wilson 95 %)", "positives", "recall")


def write_study(
    out: Path, settings: IntersectionStudy, done: Sequence[JobOutcome[Outcome]], scored: StudyScores
) -> list[PageTable]:
    """Write metrics, tables, figures and page to ``out``; return the tables for a terminal.

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
    return _text_tables(tables, approaches)


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
        "cues": cue_rows(scored.scores.cues, scored.tracked),
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


def _text_tables(tables: Mapping[str, Any], approaches: ApproachScore) -> list[PageTable]:
    """Return the tables of the study for a terminal."""
    rows, wrong = tables["intersections"], approaches.false_features
    return [
        PageTable(
            f"Simulated drives: {tables['done']} of {tables['wanted']} done",
            ("", "approaches", "at", "published"),
            (
                ("detected", _of(approaches.detected), tables["detected_m"], "34.4 m"),
                ("full intersection", _of(approaches.full), tables["full_m"], "16.2 m, 76 of 80"),
                ("with false features", _of(wrong), "", ""),
                *((f"failed {one}", "", "", "") for one in tables["failures"]),
            ),
        ),
        PageTable.of(
            "By intersection",
            rows,
            ("intersection", lambda row: row["intersection"]),
            ("detected", lambda row: f"{row['detected']} of {row['approaches']}"),
            ("mean, m", lambda row: _number(row["detected_m"])),
            ("full", lambda row: f"{row['full']} of {row['approaches']}"),
            ("mean, m", lambda row: _number(row["full_m"])),
        ),
        PageTable.of(
            "Late, missing or invented",
            tables["causes"].items(),
            ("cause", lambda item: item[0]),
            (
                "drives at each intersection",
                lambda item: ", ".join(f"{place} {drives}" for place, drives in item[1].items()),
            ),
        ),
        PageTable(
            "Cues, with the published rules and with tracked cars",
            ("cue", *CUES, "published", *(f"tracks: {name}" for name in CUES)),
            tuple(
                (
                    row["cue"],
                    *_cue_cells(row),
                    f"{row['published']:.2f}",
                    *([""] * len(CUES) if row["tracks"] is None else _cue_cells(row["tracks"])),
                )
                for row in tables["cues"]
            ),
        ),
    ]


def _cue_cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    ends = f"{_number(row['wilson_low'], 2)} to {_number(row['wilson_high'], 2)}"
    return (
        f"{_number(row['precision'], 2)} ({ends})",
        f"{row['positives']:,}",
        _number(row["recall"], 2),
    )


def _between(mean: Mapping[str, Any], digits: int = 1) -> str:
    """Return a difference with its interval as text, from the result of ``asdict``."""
    value, low, high = mean["value"], mean["low"], mean["high"]
    if math.isnan(value):
        return "-"
    if math.isnan(low):
        return f"{value:+.{digits}f} ({TOO_FEW})"
    return f"{value:+.{digits}f} ({low:+.{digits}f} to {high:+.{digits}f})"


def _of(some: Proportion) -> str:
    return f"{some.right} of {some.of}"


def _findings(scored: Sequence[RunScored]) -> tuple[Finding, ...]:
    """Return all late, missing and false features, drive by drive."""
    return tuple(
        found
        for one in scored
        if one.judged.approaches is not None
        for result in one.judged.approaches.results
        for found in approach_findings(result, one.judged.cues)
    )
