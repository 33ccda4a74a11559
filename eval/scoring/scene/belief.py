"""Are probabilities worth their names? Brier score, log score, reliability.

A step is judged by what is true at its time: within a true approach by that intersection's
features; where the truth says that no intersection is ahead, by the absence of one. Steps of one
approach hang together, so intervals count approaches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.scoring.columns import AMBIGUOUS, NONE, RunTables
from crosscue.eval.scoring.intervals import Mean, Proportion, fraction, mean
from crosscue.eval.scoring.pooling import cluster_numbers, first_reasons, summed
from crosscue.eval.scoring.truth import FEATURES, DriveTruth, has_feature

CLIP: Final = 1e-6
"""Log scores are taken of probabilities clipped to this and one minus this."""
BINS: Final = 10
SILENT: Final = "frames ahead of an intersection without any belief"


@dataclass(frozen=True, slots=True, eq=False)
class BeliefJudged:
    """One feature at N steps of one drive.

    Attributes:
        drive: Name.
        feature: Name.
        t_ns: Shape (N,).
        approach: Shape (N,): ids of true approaches; ``NONE`` where no intersection is ahead.
        probability: Shape (N,).
        is_there: Shape (N,).
        left_out: From reason to steps that could not be judged, and to frames without a step.
    """

    drive: str
    feature: str
    t_ns: NDArray[np.int64]
    approach: NDArray[np.int64]
    probability: NDArray[np.float64]
    is_there: NDArray[np.bool_]
    left_out: dict[str, int]


@dataclass(frozen=True, slots=True)
class ReliabilityBin:
    """Steps with a probability from ``low`` to ``high``.

    Attributes:
        low: Border.
        high: Border.
        steps: How many.
        mean_probability: What was said, on average.
        there: How often it was so.
    """

    low: float
    high: float
    steps: int
    mean_probability: float
    there: Proportion


@dataclass(frozen=True, slots=True)
class BeliefScore:
    """One feature over all drives.

    Attributes:
        steps: All, and frames ahead of a true intersection for which none exists.
        scored: With truth.
        left_out: Reason to steps.
        fraction_there: How often the feature is there.
        brier: Mean squared error; smaller is better, 0.25 for always saying one half.
        brier_of_base_rate: What always saying ``fraction_there`` would get.
        log_score: Mean of -ln(probability of what is so), clipped; 0.693 for one half.
        clip: Probabilities are clipped to this and one minus this for the log score.
        clipped: Steps to which that happened.
        reliability: Bins.
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
    """Second minus first belief over the steps that both have; negative is an improvement.

    Attributes:
        steps: In both.
        only_first: Steps left out because the second lacks them.
        only_second: The other way round.
        brier: Mean difference.
        log_score: Mean difference.
        verdict: Who has the better log score, where the interval excludes zero.
    """

    steps: int
    only_first: int
    only_second: int
    brier: Mean
    log_score: Mean
    verdict: str


def judge_belief(tables: RunTables, truth: DriveTruth) -> list[BeliefJudged]:
    """Lay the run's probabilities beside the truth; nothing without belief or true approaches."""
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
            )
        )
    return judged


def _labels(feature: str, at: NDArray[np.int64], truth: DriveTruth) -> NDArray[np.int8]:
    label = np.full(len(at), 0 if feature == "intersection" else NONE, np.int8)
    for one in truth.truth.approaches:
        there = has_feature(one, feature)
        label[at == one.id] = NONE if there is None else int(there)
    return label


def score_belief(judged: Sequence[BeliefJudged]) -> dict[str, BeliefScore]:
    """Scores by feature, over all drives together."""
    return {
        feature: _score([one for one in judged if one.feature == feature])
        for feature in dict.fromkeys(one.feature for one in judged)
    }


def _score(rows: Sequence[BeliefJudged]) -> BeliefScore:
    probability, is_there, clusters = _pooled(rows)
    left_out = summed(one.left_out for one in rows)
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
        reliability=reliability(probability, is_there, clusters),
    )


def _pooled(
    rows: Sequence[BeliefJudged],
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.int64]]:
    return (
        np.concatenate([one.probability for one in rows]),
        np.concatenate([one.is_there for one in rows]),
        cluster_numbers([one.drive for one in rows], [one.approach for one in rows]),
    )


def brier(probability: NDArray[np.float64], is_there: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Squared errors, shape (N,); G. W. Brier, Monthly Weather Review 78, 1950, for one event."""
    return np.asarray((probability - is_there) ** 2)


def log_score(
    probability: NDArray[np.float64], is_there: NDArray[np.bool_], clip: float = CLIP
) -> NDArray[np.float64]:
    """Minus the logarithm of the probability given to what is so, clipped, shape (N,)."""
    said = np.where(is_there, probability, 1.0 - probability)
    return np.asarray(-np.log(np.clip(said, clip, 1.0 - clip)))


def reliability(
    probability: NDArray[np.float64],
    is_there: NDArray[np.bool_],
    clusters: NDArray[np.int64],
    bins: int = BINS,
) -> tuple[ReliabilityBin, ...]:
    """Equally wide bins of probability; empty ones are left out."""
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
    """Two fusions over the same drives, feature by feature, on the steps that both have."""
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
    there = np.concatenate([np.empty(0, np.bool_), *(a.is_there for a, _ in pairs)])
    p = np.concatenate([np.empty(0), *(a.probability for a, _ in pairs)])
    q = np.concatenate([np.empty(0), *(b.probability for _, b in pairs)])
    clusters = cluster_numbers([a.drive for a, _ in pairs], [a.approach for a, _ in pairs])
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
