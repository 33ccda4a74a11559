"""Scores of beliefs as probabilities: Brier score, log score, reliability.

A step within a true approach is compared with the features of that intersection. Where the truth
states that there is no intersection ahead, the step is compared with its absence. Steps at one
place are correlated, so intervals are over places.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.scoring.columns import AMBIGUOUS, NONE, RunTables
from crosscue.eval.scoring.intervals import Mean, Proportion, fraction, mean
from crosscue.eval.scoring.places import cluster_numbers
from crosscue.eval.scoring.pooling import first_reasons, sum_counts
from crosscue.eval.scoring.truth import FEATURES, DriveTruth, has_feature
from crosscue.replay.columns import Floats, Int64s

# Probabilities are clipped to this and one minus this for the log score.
CLIP: Final = 1e-6
BINS: Final = 10
SILENT: Final = "frames ahead of an intersection without any belief"


@dataclass(frozen=True, slots=True, eq=False)
class BeliefJudged:
    """Belief in one feature at N steps of one drive, compared with truth.

    Attributes:
        drive: Name of the drive.
        feature: Name of the feature.
        t_ns: Shape (N,).
        approach: Shape (N,): ids of true approaches; ``NONE`` without an intersection ahead.
        probability: Shape (N,).
        is_there: Shape (N,): True where the feature is present.
        left_out: Numbers by reason of steps that could not be judged, and of frames without a step.
        places: Place by id of the approach.
    """

    drive: str
    feature: str
    t_ns: Int64s
    approach: Int64s
    probability: Floats
    is_there: NDArray[np.bool_]
    left_out: dict[str, int]
    places: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ReliabilityBin:
    """Steps with a probability from ``low`` to ``high``.

    Attributes:
        low: Lower edge.
        high: Upper edge.
        steps: Number of steps.
        mean_probability: Mean probability of the steps.
        there: Fraction of steps with the feature.
    """

    low: float
    high: float
    steps: int
    mean_probability: float
    there: Proportion


@dataclass(frozen=True, slots=True)
class BeliefScore:
    """Scores of one feature over all drives.

    Attributes:
        steps: Number of steps, and of frames ahead of a true intersection without a step.
        scored: Number of steps with truth.
        left_out: Number of steps by reason.
        fraction_there: Fraction of steps with the feature.
        brier: Mean squared error; smaller is better, 0.25 for a constant probability of 0.5.
        brier_of_base_rate: Brier score of the constant probability ``fraction_there``.
        log_score: Mean of -ln(probability of the true state), clipped; 0.693 for 0.5.
        clip: Probabilities are clipped to this and one minus this for the log score.
        clipped: Number of clipped steps.
        reliability: Bins of the reliability diagram.
    """

    steps: int
    scored: int
    left_out: dict[str, int]
    fraction_there: float
    brier: Mean
    brier_of_base_rate: float
    log_score: Mean
    clip: float
    clipped: int
    reliability: tuple[ReliabilityBin, ...]


@dataclass(frozen=True, slots=True)
class BeliefDifference:
    """Scores of the second minus the first belief, over common steps; negative is better.

    Attributes:
        steps: Number of common steps.
        only_first: Number of steps that only the first belief has.
        only_second: Number of steps that only the second belief has.
        brier: Mean difference of Brier scores.
        log_score: Mean difference of log scores.
        verdict: The belief with the better log score, if the interval excludes zero.
    """

    steps: int
    only_first: int
    only_second: int
    brier: Mean
    log_score: Mean
    verdict: str


def judge_belief(tables: RunTables, truth: DriveTruth) -> list[BeliefJudged]:
    """Compare the run's probabilities with the truth; empty without belief or true approaches."""
    if tables.belief is None or not truth.truth.approaches:
        return []
    belief = tables.belief
    at, crossing = truth.approach_at(belief.t_ns), truth.is_crossing(belief.t_ns)
    reported = truth.is_annotated(belief.t_ns)
    frames = np.empty(0, np.int64) if tables.frames_ns is None else tables.frames_ns
    ahead = frames[truth.approach_at(frames) != NONE]
    silent = int((~np.isin(ahead, belief.t_ns)).sum())
    order = [name for name in FEATURES if name in belief.features]
    order += sorted(set(belief.features) - set(FEATURES))
    judged = []
    for name in order:
        values = belief.features[name]
        label = _labels(name, at, truth)
        reasons = {
            "not a number": ~np.isfinite(values),
            "outside the truth's time": ~reported,
            "in the intersection": crossing,
            "no intersection ahead": (at == NONE) & (label == NONE),
            "the truth does not annotate this feature": label == NONE,
        }
        left, left_out = first_reasons(np.ones(len(values), np.bool_), reasons)
        if silent:
            left_out[SILENT] = silent
        if "belief" in tables.ambiguous:
            left_out[AMBIGUOUS] = tables.ambiguous["belief"]
        judged.append(
            BeliefJudged(
                truth.drive,
                name,
                belief.t_ns[left],
                at[left],
                values[left],
                label[left] == 1,
                left_out,
                truth.places,
            )
        )
    return judged


def _labels(feature: str, at: Int64s, truth: DriveTruth) -> NDArray[np.int8]:
    label = np.full(len(at), 0 if feature == "intersection" else NONE, np.int8)
    for one in truth.truth.approaches:
        there = has_feature(one, feature)
        label[at == one.id] = NONE if there is None else int(there)
    return label


def score_belief(judged: Sequence[BeliefJudged]) -> dict[str, BeliefScore]:
    """Return scores by feature, over all drives together."""
    return {
        feature: _score([one for one in judged if one.feature == feature])
        for feature in dict.fromkeys(one.feature for one in judged)
    }


def _score(rows: Sequence[BeliefJudged]) -> BeliefScore:
    probability, is_there, clusters = _pooled(rows)
    left_out = sum_counts(one.left_out for one in rows)
    base = float(is_there.mean()) if len(is_there) else math.nan
    return BeliefScore(
        steps=len(probability) + sum(left_out.values()),
        scored=len(probability),
        left_out=left_out,
        fraction_there=base,
        brier=mean(brier(probability, is_there), clusters),
        brier_of_base_rate=base * (1.0 - base),
        log_score=mean(log_score(probability, is_there), clusters),
        clip=CLIP,
        clipped=int(((probability < CLIP) | (probability > 1.0 - CLIP)).sum()),
        reliability=reliability_bins(probability, is_there, clusters),
    )


def _pooled(rows: Sequence[BeliefJudged]) -> tuple[Floats, NDArray[np.bool_], Int64s]:
    return (
        np.concatenate([np.empty(0), *(one.probability for one in rows)]),
        np.concatenate([np.empty(0, np.bool_), *(one.is_there for one in rows)]),
        cluster_numbers(rows),
    )


def brier(probability: Floats, is_there: NDArray[np.bool_]) -> Floats:
    """Return squared errors, (N,) (G. W. Brier, Monthly Weather Review 78, 1950, for one event)."""
    return np.asarray((probability - is_there) ** 2)


def log_score(probability: Floats, is_there: NDArray[np.bool_], clip: float = CLIP) -> Floats:
    """Return minus the logarithm of the clipped probability of the true state, shape (N,)."""
    likelihood = np.where(is_there, probability, 1.0 - probability)
    return np.asarray(-np.log(np.clip(likelihood, clip, 1.0 - clip)))


def reliability_bins(
    probability: Floats, is_there: NDArray[np.bool_], clusters: Int64s, bins: int = BINS
) -> tuple[ReliabilityBin, ...]:
    """Return bins of equal width in probability, without empty bins."""
    place = np.minimum((probability * bins).astype(np.int64), bins - 1)
    return tuple(
        ReliabilityBin(
            low=number / bins,
            high=(number + 1) / bins,
            steps=int(mine.sum()),
            mean_probability=float(probability[mine].mean()),
            there=fraction(is_there[mine], clusters[mine]),
        )
        for number in range(bins)
        for mine in [place == number]
        if mine.any()
    )


def compare_belief(
    first: Sequence[BeliefJudged], second: Sequence[BeliefJudged]
) -> dict[str, BeliefDifference]:
    """Compare two beliefs over the same drives by feature, on common steps."""
    names = [
        name
        for name in dict.fromkeys(one.feature for one in first)
        if name in {one.feature for one in second}
    ]
    return {
        name: _difference(
            [one for one in first if one.feature == name],
            [one for one in second if one.feature == name],
        )
        for name in names
    }


def _difference(first: Sequence[BeliefJudged], second: Sequence[BeliefJudged]) -> BeliefDifference:
    pairs: list[tuple[BeliefJudged, BeliefJudged]] = []
    drives = {one.drive: one for one in second}
    for one in first:
        other = drives.get(one.drive)
        if other is not None:
            _, mine, theirs = np.intersect1d(one.t_ns, other.t_ns, return_indices=True)
            pairs.append((_taken(one, mine), _taken(other, theirs)))
    p, there, clusters = _pooled([a for a, _ in pairs])
    q, _, _ = _pooled([b for _, b in pairs])
    log = mean(log_score(q, there) - log_score(p, there), clusters)
    return BeliefDifference(
        steps=len(there),
        only_first=sum(len(one.t_ns) for one in first) - len(there),
        only_second=sum(len(one.t_ns) for one in second) - len(there),
        brier=mean(brier(q, there) - brier(p, there), clusters),
        log_score=log,
        verdict="second" if log.high < 0 else "first" if log.low > 0 else "undecided",
    )


def _taken(one: BeliefJudged, rows: NDArray[np.intp]) -> BeliefJudged:
    return replace(
        one,
        t_ns=one.t_ns[rows],
        approach=one.approach[rows],
        probability=one.probability[rows],
        is_there=one.is_there[rows],
    )
