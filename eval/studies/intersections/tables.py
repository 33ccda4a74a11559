"""The published numbers of chapter 3, and a study's beside them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from crosscue.eval.scoring.drives import Scores
from crosscue.eval.scoring.intervals import TOO_FEW, Mean, Proportion, wilson
from crosscue.eval.scoring.runs import RunScored
from crosscue.eval.scoring.scene.approaches import ApproachResult
from crosscue.eval.scoring.scene.belief import BeliefDifference
from crosscue.eval.scoring.scene.cues import CueScore
from crosscue.eval.studies.attribution import Attribution
from crosscue.replay.vehicle.cue_table import groups


@dataclass(frozen=True, slots=True)
class StudyScores:
    """The scored study.

    Attributes:
        scored: Every drive beside its truth.
        scores: All together.
        worth: What each of the nine cues was worth; empty where that was not asked.
        calibrated: All again, each intersection with messages learned at the others; None where
            there are too few.
        difference: Calibrated less source, by feature.
    """

    scored: tuple[RunScored, ...]
    scores: Scores
    worth: dict[str, Attribution]
    calibrated: Scores | None
    difference: dict[str, BeliefDifference]


PUBLISHED_RUNS: Final[Mapping[str, tuple[float, float]]] = {
    "E-01": (38.6, 19.8), "F-05": (41.2, 29.4), "A-07": (75.2, 30.1), "B-10": (47.7, 17.6),
    "G-03": (43.5, 9.8), "E-07": (8.2, 7.6), "D-10": (30.1, 11.8),
}  # fmt: skip
"""Single runs quoted in the text: metres at detection and at full detection."""

Row = dict[str, Any]


def cue_rows(cues: Mapping[str, CueScore]) -> list[Row]:
    """One row a cue of Table 5, pooled over its columns.

    ``precision`` asks whether the thing itself is there (lane lines and vehicles past: whether the
    road goes on); ``feature_precision`` whether what the cue says of the intersection is so.
    """
    rows: list[Row] = []
    for group in groups().values():
        published = group[0]
        some = [cues[cue.name] for cue in group if cue.name in cues]
        right = sum(one.precision.right for one in some)
        of = sum(one.precision.of for one in some)
        # Clusters are counted column by column, so a pooled interval over them is the widest.
        low, high = wilson(right, of)
        lows = [one.precision.clusters_low for one in some if one.precision.of]
        highs = [one.precision.clusters_high for one in some if one.precision.of]
        recalls = [one.recall for one in some if one.recall is not None]
        ways = [one.readings["feature"].precision for one in some if "feature" in one.readings]
        rows.append(
            {
                "cue": published.title,
                "published": published.precision,
                "published_is_bound": published.precision_is_lower_bound,
                "precision": right / of if of else math.nan,
                "wilson_low": low,
                "wilson_high": high,
                "clusters_low": min(lows, default=math.nan),
                "clusters_high": max(highs, default=math.nan),
                "positives": of,
                "feature_precision": _pooled(ways),
                "recall": _pooled(recalls),
                "recall_of": sum(one.of for one in recalls),
            }
        )
    return rows


def _pooled(fractions: Sequence[Proportion]) -> float:
    of = sum(one.of for one in fractions)
    return sum(one.right for one in fractions) / of if of else math.nan


def intersection_rows(results: Sequence[ApproachResult]) -> list[Row]:
    """One row an intersection: how often and from where it was detected, and why not."""
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
    """The published single runs beside the simulated ones of the same name.

    Conditions of one name are not the same drive: it is a comparison of size, not of runs.
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
    """What each cue was worth; distances and log scores are compared approach by approach."""
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
    """A mean with its interval."""
    if math.isnan(mean.value):
        return "none"
    if math.isnan(mean.low):
        return f"{mean.value:.1f} m ({TOO_FEW})"
    return f"{mean.value:.1f} m ({mean.low:.1f} to {mean.high:.1f})"
