"""Ablation of cues: every measure with one cue left out, as if it had not been searched.

Detectors do not run again; the caller supplies the estimates. Distances and log scores are compared
approach by approach, so their intervals are those of paired differences.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np

from crosscue.eval.pipeline.scene.variants import scene_tables
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.scoring.columns import RunTables
from crosscue.eval.scoring.drives import (
    DEFAULTS,
    DriveJudged,
    PooledScores,
    ScoreSettings,
    as_metrics,
    pool_scores,
    score_drive,
)
from crosscue.eval.scoring.intervals import Mean, mean
from crosscue.eval.scoring.metric_values import metric_values
from crosscue.eval.scoring.run_tables import in_log_time
from crosscue.eval.scoring.scene.approaches import ApproachResult, places_of_results
from crosscue.eval.scoring.scene.belief import BeliefDifference, compare_belief
from crosscue.eval.scoring.truth import DriveTruth
from crosscue.replay.columns import Int64s
from crosscue.replay.vehicle import cue_table
from crosscue.replay.vehicle.vehicle import Vehicle

SHOWN: Final = ("approaches", "belief", "range")
PASSED_OVER: Final = frozenset(
    {"by_intersection", "by_condition", "by_distance", "by_control", "failures"}
)


# Estimates a drive again as if some cues had not been searched.
EstimateWithout: TypeAlias = Callable[[frozenset[str]], RunTables]


class AttributedDrive(NamedTuple):
    """A judged drive, its truth, and the function that estimates it again."""

    judged: DriveJudged
    truth: DriveTruth
    estimate: EstimateWithout


@dataclass(frozen=True, slots=True)
class Worth:
    """A measure with all cues and without one; NaN if it could not be scored."""

    with_all: float
    without: float


@dataclass(frozen=True, slots=True)
class Attribution:
    """Effect of one cue, or of both sides of a cue, on the scores.

    Attributes:
        cues: Cues that are left out together.
        scores: All scores without them.
        measures: Measures that changed, by path.
        detected_m: Gain in the distance at detection due to the cue, over the approaches detected
            with and without it.
        full_m: Gain in the distance at full detection due to the cue.
        detected_only_with: Number of approaches detected only with the cue.
        detected_only_without: Number of approaches detected only without the cue.
        full_only_with: Number of approaches fully detected only with the cue.
        full_only_without: Number of approaches fully detected only without the cue.
        belief: Scores without the cue minus with it, by feature; positive if the cue helps.
    """

    cues: tuple[str, ...]
    scores: PooledScores
    measures: dict[str, Worth]
    detected_m: Mean
    full_m: Mean
    detected_only_with: int
    detected_only_without: int
    full_only_with: int
    full_only_without: int
    belief: dict[str, BeliefDifference]


def attribute(
    drives: Sequence[AttributedDrive],
    groups: Mapping[str, Sequence[str]] | None = None,
    settings: ScoreSettings = DEFAULTS,
) -> dict[str, Attribution]:
    """Leave out each group of cues in turn, in all drives.

    Args:
        drives: Drives, judged with the same settings.
        groups: Cues to leave out together, by name; None for the rows of Table 5.
        settings: Settings of the scores.
    """
    if groups is None:
        groups = {name: [cue.name for cue in some] for name, some in cue_table.groups().items()}
    scores = pool_scores([one.judged for one in drives], settings)
    return {name: _without(drives, scores, tuple(cues), settings) for name, cues in groups.items()}


def _without(
    drives: Sequence[AttributedDrive],
    whole: PooledScores,
    cues: tuple[str, ...],
    settings: ScoreSettings,
) -> Attribution:
    left = frozenset(cues)
    judged = [score_drive(one.estimate(left), one.truth, settings) for one in drives]
    scores = pool_scores(judged, settings)
    pairs = _pairs(whole, scores)
    detected = [(a.detected_m, b.detected_m) for a, b in pairs]
    full = [(a.full_m, b.full_m) for a, b in pairs]
    at = places_of_results([a for a, _ in pairs])
    return Attribution(
        cues=cues,
        scores=scores,
        measures=_changed(whole, scores),
        detected_m=_gain(detected, at),
        full_m=_gain(full, at),
        detected_only_with=_only(detected, 0),
        detected_only_without=_only(detected, 1),
        full_only_with=_only(full, 0),
        full_only_without=_only(full, 1),
        belief=compare_belief(
            [part for one in drives for part in one.judged.belief],
            [part for one in judged for part in one.belief],
        ),
    )


def _pairs(
    whole: PooledScores, without: PooledScores
) -> list[tuple[ApproachResult, ApproachResult]]:
    if whole.approaches is None or without.approaches is None:
        return []
    others = {(one.drive, one.approach): one for one in without.approaches.results}
    return [(one, others[one.drive, one.approach]) for one in whole.approaches.results]


def _gain(pairs: Sequence[tuple[float | None, float | None]], at: Int64s) -> Mean:
    gains = [math.nan if a is None or b is None else a - b for a, b in pairs]
    return mean(np.array(gains, np.float64), at)


def _only(pairs: Sequence[tuple[float | None, float | None]], side: int) -> int:
    return sum(pair[side] is not None and pair[1 - side] is None for pair in pairs)


def _changed(whole: PooledScores, without: PooledScores) -> dict[str, Worth]:
    trees = [as_metrics(one) for one in (whole, without)]
    values = [
        metric_values({name: tree[name] or {} for name in SHOWN}, parts=False) for tree in trees
    ]
    found: dict[str, Worth] = {}
    for path in dict.fromkeys([*values[0], *values[1]]):
        if PASSED_OVER & set(path.split(".")):
            continue
        a, b = (one[path].value if path in one else math.nan for one in values)
        if a != b and not (math.isnan(a) and math.isnan(b)):
            found[path] = Worth(a, b)
    return found


def attribution_tree(found: Mapping[str, Attribution]) -> dict[str, Any]:
    """Return the effects as plain values for ``metrics.json``, without the scores."""
    return {
        name: {key: value for key, value in asdict(one).items() if key != "scores"}
        for name, one in found.items()
    }


def attribution_lines(found: Mapping[str, Attribution]) -> list[str]:
    """Return a text table of the effect of each cue, within 80 columns."""
    lines = ["left out        full m   only with  only w/o  log score: left   right  straight"]
    for name, one in found.items():
        scores = [
            _signed(one.belief[key].log_score.value) if key in one.belief else "-"
            for key in ("left", "right", "straight")
        ]
        lines.append(
            f"{name:14} {_signed(one.full_m.value, 1):>7} {one.full_only_with:>11} "
            f"{one.full_only_without:>9} {scores[0]:>16} {scores[1]:>7} {scores[2]:>9}"
        )
    lines.append("full m: gain in distance due to the cue; log score: loss without the cue")
    return lines


def _signed(value: float, digits: int = 3) -> str:
    return "-" if math.isnan(value) else f"{value:+.{digits}f}"


def estimate_of(run: RunFolder, vehicle: Vehicle | None = None) -> EstimateWithout:
    """Return a function that estimates from a run's detections and pose, without pictures.

    Args:
        run: Run with a finished detect stage.
        vehicle: Other settings; default: those of the run.

    Raises (when called):
        RunError: No detector ran on the run's camera.
    """

    def estimate(cues: frozenset[str], /) -> RunTables:
        timeline = run.drive_manifest().timeline
        again = scene_tables(run, vehicle, cues)
        tables = {name: again[name] for name in ("cues", "range", "belief")}
        frames = run.table("frames", ["t_ns", "segment", "log_t_ns"])
        return in_log_time(str(run.path), {"frames": frames, **tables}, timeline)

    return estimate
