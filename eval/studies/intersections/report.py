"""Tables, page and other files of the intersections study, with the numbers of chapter 3."""

from __future__ import annotations

import base64
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from crosscue.eval.batch.jobs import JobOutcome
from crosscue.eval.failures.causes import GOOD, Finding, approach_findings, by_cause
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.report.html import write_page
from crosscue.eval.report.scene_figures import PUBLISHED_DETECTED_M, PUBLISHED_FULL_M
from crosscue.eval.scoring.drives import PooledScores
from crosscue.eval.scoring.files import write_scores
from crosscue.eval.scoring.intervals import Mean, Proportion, between, mean, wilson
from crosscue.eval.scoring.runs import RunScored, metrics_of
from crosscue.eval.scoring.scene.approaches import ApproachResult, ApproachScore, places_of_results
from crosscue.eval.scoring.scene.belief import BeliefDifference
from crosscue.eval.scoring.scene.cues import CueScore
from crosscue.eval.studies.attribution import Attribution
from crosscue.eval.studies.study import PAGE, PageTable
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.vehicle.cue_table import groups
from crosscue.replay.versions import versions

from .figures import draw_beliefs, draw_study_distances, draw_study_reliability, write_sheet
from .settings import IntersectionStudy

TEMPLATE: Final = "intersections.html.j2"
TABLES: Final = "study.json"
SHEET: Final = "detections.jpg"
CUES: Final = ("precision (Wilson 95 %)", "positives", "recall")
# Single runs in the dissertation's text: metres at detection and at full detection.
PUBLISHED_RUNS: Final[Mapping[str, tuple[float, float]]] = {
    "E-01": (38.6, 19.8), "F-05": (41.2, 29.4), "A-07": (75.2, 30.1), "B-10": (47.7, 17.6),
    "G-03": (43.5, 9.8), "E-07": (8.2, 7.6), "D-10": (30.1, 11.8),
}  # fmt: skip
Row = dict[str, Any]
# Cues of cars, with which the rule that tracks them is compared.
CARS: Final = ("cross_traffic", "parked", "oncoming", "outgoing")


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
        {"number": _number, "signed": _signed, "between": _difference},
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
        "conditions": condition_costs(approaches.results),
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


def _difference(mean: Mapping[str, Any], digits: int = 1) -> str:
    """Return a difference with its interval as text, from the result of ``asdict``."""
    value, low, high = mean["value"], mean["low"], mean["high"]
    sign = f"+.{digits}f"
    return "-" if math.isnan(value) else f"{value:{sign}} ({between(low, high, sign)})"


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


@dataclass(frozen=True, slots=True)
class StudyScores:
    """Scores of the study.

    Attributes:
        scored: Every drive, compared with its truth.
        scores: Scores of all drives together.
        worth: Effect of each of the nine cues; empty if not requested.
        tracked: Scores of the cues with ``cars.kind = "tracks"``.
        calibrated: Scores with messages learned at the other intersections; None if there are too
            few intersections.
        difference: Belief of the calibrated minus the published messages, by feature.
    """

    scored: tuple[RunScored, ...]
    scores: PooledScores
    worth: dict[str, Attribution]
    tracked: Mapping[str, CueScore]
    calibrated: PooledScores | None
    difference: dict[str, BeliefDifference]


def cue_rows(cues: Mapping[str, CueScore], tracked: Mapping[str, CueScore]) -> list[Row]:
    """Return one row per cue of Table 5, pooled over its columns.

    ``precision`` compares with objects (lane lines and vehicles past the intersection: with the
    continuation of the road), and ``feature_precision`` with the cue's feature of the intersection.
    Cues of cars also have a row of the rule that tracks them, under ``tracks``.
    """
    rows: list[Row] = []
    for group in groups().values():
        published = group[0]
        some = [cues[cue.name] for cue in group if cue.name in cues]
        others = [tracked[cue.name] for cue in group if cue.name in tracked]
        ways = [one.readings["feature"].precision for one in some if "feature" in one.readings]
        rows.append(
            {
                "cue": published.title,
                "published": published.precision,
                "published_is_bound": published.precision_is_lower_bound,
                **_cue_row(some),
                "feature_precision": _pooled(ways),
                "tracks": _cue_row(others) if group[0].name.startswith(CARS) else None,
            }
        )
    return rows


def _cue_row(some: Sequence[CueScore]) -> Row:
    right = sum(one.precision.right for one in some)
    of = sum(one.precision.of for one in some)
    recalls = [one.recall for one in some if one.recall is not None]
    # Clusters are known only per column, so the widest interval over clusters is used.
    low, high = wilson(right, of)
    lows = [one.precision.clusters_low for one in some if one.precision.of]
    highs = [one.precision.clusters_high for one in some if one.precision.of]
    return {
        "precision": right / of if of else math.nan,
        "wilson_low": low,
        "wilson_high": high,
        "clusters_low": min(lows, default=math.nan),
        "clusters_high": max(highs, default=math.nan),
        "positives": of,
        "recall": _pooled(recalls),
        "recall_of": sum(one.of for one in recalls),
    }


def _pooled(fractions: Sequence[Proportion]) -> float:
    of = sum(one.of for one in fractions)
    return sum(one.right for one in fractions) / of if of else math.nan


def intersection_rows(results: Sequence[ApproachResult]) -> list[Row]:
    """Return one row per intersection: frequency and distance of detection, and failures."""
    rows: list[Row] = []
    for name in sorted({one.intersection for one in results}):
        mine = [one for one in results if one.intersection == name]
        found = [one.detected_m for one in mine if one.detected_m is not None]
        full = [one.full_m for one in mine if one.full_m is not None]
        rows.append(
            {
                "intersection": name,
                "approaches": len(mine),
                "detected": len(found),
                "detected_m": _mean(found),
                "full": len(full),
                "full_m": _mean(full),
                "nearest_full_m": min(full, default=math.nan),
                "false_features": sum(bool(one.false_features) for one in mine),
                "why_not_full": dict(Counter(one.why_not_full for one in mine if one.why_not_full)),
            }
        )
    return rows


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan


def quoted_rows(scored: StudyScores) -> list[Row]:
    """Return the published single runs and the simulated runs of the same name.

    Runs of the same name have the same conditions, but are not the same drive.
    """
    found = {one.judged.coverage.drive.rpartition("/")[2]: one.judged for one in scored.scored}
    rows: list[Row] = []
    for name, (detected_m, full_m) in PUBLISHED_RUNS.items():
        judged = found.get(name)
        one = None
        if judged is not None and judged.approaches is not None:
            one = judged.approaches.results[0]
        rows.append(
            {
                "run": name,
                "published_detected_m": detected_m,
                "published_full_m": full_m,
                "detected_m": None if one is None else one.detected_m,
                "full_m": None if one is None else one.full_m,
                "was_run": one is not None,
            }
        )
    return rows


def attribution_rows(scored: StudyScores) -> list[Row]:
    """Return the effect of each cue; distances and log scores are compared by approach."""
    whole = scored.scores
    rows: list[Row] = []
    for group, one in scored.worth.items():
        without = one.scores
        row: Row = {
            "cue": group,
            "detected_lost": one.detected_only_with,
            "detected_gained": one.detected_only_without,
            "detected_m": asdict(one.detected_m),
            "full_lost": one.full_only_with,
            "full_gained": one.full_only_without,
            "full_m": asdict(one.full_m),
            "log_score": {name: asdict(belief.log_score) for name, belief in one.belief.items()},
        }
        if whole.approaches is not None and without.approaches is not None:
            row["false_features"] = (
                without.approaches.false_features.right - whole.approaches.false_features.right
            )
        rows.append(row)
    return rows


def mean_text(mean: Mean) -> str:
    """Return a mean with its interval as text."""
    if math.isnan(mean.value):
        return "none"
    return f"{mean.value:.1f} m ({between(mean.low, mean.high, '.1f')})"


def condition_costs(results: Sequence[ApproachResult]) -> list[Row]:
    """Compare every bad condition with good conditions at the same intersection.

    Differences in distance are negative if detection is later; ``undetected`` and ``not_full``
    count approaches unlike good ones. Conditions that always apply at an intersection (its
    vegetation) have no comparison and are ignored.
    """
    always = _always(results)
    tags = sorted({tag for one in results for tag in one.conditions} - GOOD)
    return [
        _cost(tag, results, always)
        for tag in tags
        if any(tag in _changing(one, always) for one in results)
    ]


def _always(results: Sequence[ApproachResult]) -> dict[str, frozenset[str]]:
    shared: dict[str, frozenset[str]] = {}
    for one in results:
        tags = frozenset(one.conditions)
        shared[one.intersection] = shared.get(one.intersection, tags) & tags
    return shared


def _changing(one: ApproachResult, always: Mapping[str, frozenset[str]]) -> set[str]:
    return set(one.conditions) - GOOD - always[one.intersection]


def _cost(tag: str, results: Sequence[ApproachResult], always: Mapping[str, frozenset[str]]) -> Row:
    good: dict[str, list[ApproachResult]] = {}
    for one in results:
        if not _changing(one, always):
            good.setdefault(one.intersection, []).append(one)
    bad = [one for one in results if tag in _changing(one, always) and one.intersection in good]
    at = places_of_results(bad)
    row: Row = {"condition": tag, "approaches": len(bad)}
    never: dict[str, int] = {}
    for name, missed in (("detected_m", "undetected"), ("full_m", "not_full")):
        pairs = [
            (getattr(one, name), [getattr(other, name) for other in good[one.intersection]])
            for one in bad
        ]
        row[name] = asdict(mean(np.array([_less(*pair) for pair in pairs]), at))
        never[missed] = sum(m is None and any(g is not None for g in some) for m, some in pairs)
    return row | never


def _less(value: float | None, others: Sequence[float | None]) -> float:
    known = [one for one in others if one is not None]
    return math.nan if value is None or not known else value - sum(known) / len(known)
