"""Tables of a study's results with the published numbers of chapter 3."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from crosscue.eval.failures.causes import GOOD
from crosscue.eval.scoring.drives import PooledScores
from crosscue.eval.scoring.intervals import TOO_FEW, Mean, Proportion, mean, wilson
from crosscue.eval.scoring.runs import RunScored
from crosscue.eval.scoring.scene.approaches import ApproachResult, places_of_results
from crosscue.eval.scoring.scene.belief import BeliefDifference
from crosscue.eval.scoring.scene.cues import CueScore
from crosscue.eval.studies.attribution import Attribution
from crosscue.replay.vehicle.cue_table import groups


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


# Single runs in the dissertation's text: metres at detection and at full detection.
PUBLISHED_RUNS: Final[Mapping[str, tuple[float, float]]] = {
    "E-01": (38.6, 19.8), "F-05": (41.2, 29.4), "A-07": (75.2, 30.1), "B-10": (47.7, 17.6),
    "G-03": (43.5, 9.8), "E-07": (8.2, 7.6), "D-10": (30.1, 11.8),
}  # fmt: skip

Row = dict[str, Any]
# Cues of cars, with which the rule that tracks them is compared.
CARS: Final = ("cross_traffic", "parked", "oncoming", "outgoing")


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
        reasons: dict[str, int] = {}
        for one in mine:
            if one.why_not_full:
                reasons[one.why_not_full] = reasons.get(one.why_not_full, 0) + 1
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
                "why_not_full": reasons,
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
    if math.isnan(mean.low):
        return f"{mean.value:.1f} m ({TOO_FEW})"
    return f"{mean.value:.1f} m ({mean.low:.1f} to {mean.high:.1f})"


@dataclass(frozen=True, slots=True)
class ConditionCost:
    """Effect of a condition, compared with good conditions at the same intersections.

    Attributes:
        condition: Tag of the condition.
        approaches: Number of approaches with it, at intersections with approaches in good
            conditions.
        detected_m: Difference in the distance at detection; negative is later.
        full_m: Difference in the distance at full detection; negative is later.
        undetected: Number of those approaches that were never detected, unlike good ones.
        not_full: Number of those approaches that were never fully detected, unlike good ones.
    """

    condition: str
    approaches: int
    detected_m: Mean
    full_m: Mean
    undetected: int
    not_full: int


def condition_costs(results: Sequence[ApproachResult]) -> tuple[ConditionCost, ...]:
    """Compare every bad condition with good conditions at the same intersection.

    Conditions that always apply at an intersection (its vegetation) have no comparison and are
    ignored.
    """
    always = _always(results)
    tags = sorted({tag for one in results for tag in one.conditions} - GOOD)
    return tuple(
        _cost(tag, results, always)
        for tag in tags
        if any(tag in _changing(one, always) for one in results)
    )


def _always(results: Sequence[ApproachResult]) -> dict[str, frozenset[str]]:
    shared: dict[str, frozenset[str]] = {}
    for one in results:
        tags = frozenset(one.conditions)
        shared[one.intersection] = shared.get(one.intersection, tags) & tags
    return shared


def _changing(one: ApproachResult, always: Mapping[str, frozenset[str]]) -> set[str]:
    return set(one.conditions) - GOOD - always[one.intersection]


def _cost(
    tag: str, results: Sequence[ApproachResult], always: Mapping[str, frozenset[str]]
) -> ConditionCost:
    good: dict[str, list[ApproachResult]] = {}
    for one in results:
        if not _changing(one, always):
            good.setdefault(one.intersection, []).append(one)
    bad = [one for one in results if tag in _changing(one, always) and one.intersection in good]
    pairs = [(one, good[one.intersection]) for one in bad]
    detected = [_less(one.detected_m, [g.detected_m for g in some]) for one, some in pairs]
    full = [_less(one.full_m, [g.full_m for g in some]) for one, some in pairs]
    at = places_of_results(bad)
    return ConditionCost(
        tag,
        len(bad),
        mean(np.array(detected), at),
        mean(np.array(full), at),
        sum(
            one.detected_m is None and any(g.detected_m is not None for g in some)
            for one, some in pairs
        ),
        sum(one.full_m is None and any(g.full_m is not None for g in some) for one, some in pairs),
    )


def _less(value: float | None, others: Sequence[float | None]) -> float:
    known = [one for one in others if one is not None]
    return math.nan if value is None or not known else value - sum(known) / len(known)
