"""Score the beliefs of the study of layouts, with intervals over layouts.

Every picture counts, so that all beliefs are scored on the same pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.scoring.intervals import Mean, fraction, mean
from crosscue.eval.scoring.scene.belief import brier, log_score
from crosscue.eval.scoring.scene.detection import CONFIRM_FRAMES, held
from crosscue.eval.scoring.scene.trade import Reached, TradePoint, reached, trade_off
from crosscue.eval.scoring.truth import FEATURES as FEATURES
from crosscue.replay.columns import Floats, Int64s

THRESHOLD: Final = 0.9
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class DriveBelief:
    """Belief in N pictures of a drive.

    Attributes:
        drive: Name of the drive.
        layout: Name of the layout, whose drives are a cluster.
        features: True features, where known.
        start_m: Shape (N,): range to the intersection ahead; NaN without one.
        probabilities: Shape (N, features), in the order of ``FEATURES``.
        established: Shape (N,): True where the intersection's presence is established.
        is_silent: Shape (N,): True outside approaches, where the base rates apply.
    """

    drive: str
    layout: str
    features: Mapping[str, bool]
    start_m: Floats
    probabilities: Floats
    established: Flags
    is_silent: Flags


@dataclass(frozen=True, slots=True)
class LayoutScore:
    """Scores of one kind of belief over all drives, with intervals over layouts.

    Attributes:
        brier: Mean squared error over pictures and features.
        log_score: Mean of -ln(probability of the true state).
        brier_by_feature: Mean squared error by feature.
        false_features: Mean number of absent features above 0.9 per drive.
        full: Fraction of the drives to an intersection with full detection.
        full_m: True distance at full detection.
        full_before_detected: Fraction of pictures in which a direction is above 0.9 but the
            intersection is not.
        silent: Fraction of pictures outside approaches.
        trade: Full detection at rates of false features, each with its own threshold.
    """

    brier: Mean
    log_score: Mean
    brier_by_feature: Mapping[str, Mean]
    false_features: Mean
    full: Mean
    full_m: Mean
    full_before_detected: Mean
    silent: Mean
    trade: tuple[TradePoint, ...]


@dataclass(frozen=True, slots=True)
class LayoutDifference:
    """Scores of one kind minus those of another over the same pictures; negative is better."""

    brier: Mean
    log_score: Mean
    false_features: Mean


@dataclass(frozen=True, slots=True)
class LayoutScores:
    """All results.

    Attributes:
        kinds: Score by kind of belief.
        less: Differences of the belief over time from each other kind, by their names.
        cues: Differences of the belief over time without cues from that with all, by cues left out.
        rules: Score without a rule, by rule (empty for all rules).
        rules_less: Differences of the belief without a rule from that with all, by rule.
        drives: Number of drives.
        layouts: Number of layouts.
        exponents: Exponent and lapse of the belief over time, by fold.
    """

    kinds: Mapping[str, LayoutScore]
    less: Mapping[str, LayoutDifference]
    cues: Mapping[str, LayoutDifference]
    rules: Mapping[str, LayoutScore]
    rules_less: Mapping[str, LayoutDifference]
    drives: int
    layouts: int
    exponents: Mapping[int, tuple[float, float]]


def score_layouts(beliefs: Sequence[DriveBelief]) -> LayoutScore:
    """Score one kind of belief."""
    rows = _Rows.of(beliefs)
    drives = _clusters([one.layout for one in beliefs])
    full = [_full_m(one) for one in beliefs if one.features["intersection"]]
    at = _clusters([one.layout for one in beliefs if one.features["intersection"]])
    found_m = np.array([np.nan if one is None else one for one in full], np.float64)
    return LayoutScore(
        brier=mean(rows.brier, rows.cluster),
        log_score=mean(rows.log_score, rows.cluster),
        brier_by_feature={
            name: mean(rows.brier[rows.feature == i], rows.cluster[rows.feature == i])
            for i, name in enumerate(FEATURES)
        },
        false_features=mean(_false_features(beliefs), drives),
        full=_fraction(np.isfinite(found_m), at),
        full_m=mean(found_m, at),
        full_before_detected=_of_pictures(beliefs, _ways_first),
        silent=_of_pictures(beliefs, lambda one: one.is_silent),
        trade=trade_off([_reached(one) for one in beliefs], drives),
    )


def score_difference(
    first: Sequence[DriveBelief], second: Sequence[DriveBelief]
) -> LayoutDifference:
    """Return the scores of the second minus the first belief, over the same pictures.

    Raises:
        ValueError: The beliefs are not about the same drives in the same order.
    """
    if [one.drive for one in first] != [one.drive for one in second]:
        raise ValueError("difference: expected beliefs about the same drives, in the same order")
    before, after = _Rows.of(first), _Rows.of(second)
    return LayoutDifference(
        mean(after.brier - before.brier, before.cluster),
        mean(after.log_score - before.log_score, before.cluster),
        mean(
            _false_features(second) - _false_features(first),
            _clusters([one.layout for one in first]),
        ),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Columns with one row per picture and known feature."""

    brier: Floats
    log_score: Floats
    feature: Int64s
    cluster: Int64s

    @classmethod
    def of(cls, beliefs: Sequence[DriveBelief]) -> _Rows:
        clusters = _clusters([one.layout for one in beliefs])
        probabilities, is_there, feature, cluster = [], [], [], []
        for one, number in zip(beliefs, clusters.tolist(), strict=True):
            for i, name in enumerate(FEATURES):
                if name in one.features:
                    n = len(one.probabilities)
                    probabilities.append(one.probabilities[:, i])
                    is_there.append(np.full(n, one.features[name]))
                    feature.append(np.full(n, i))
                    cluster.append(np.full(n, number))
        p, so = np.concatenate(probabilities), np.concatenate(is_there)
        return cls(brier(p, so), log_score(p, so), np.concatenate(feature), np.concatenate(cluster))


def _clusters(layouts: Sequence[str]) -> Int64s:
    numbers = {name: i for i, name in enumerate(dict.fromkeys(layouts))}
    return np.array([numbers[name] for name in layouts], np.int64)


def _false_features(beliefs: Sequence[DriveBelief]) -> Floats:
    return np.array(
        [
            sum(
                bool((one.probabilities[~one.is_silent, i] > THRESHOLD).any())
                for i, name in enumerate(FEATURES)
                if one.features.get(name) is False
            )
            for one in beliefs
        ],
        np.float64,
    )


def _full_m(one: DriveBelief) -> float | None:
    """Return the distance where all present features are believed for several pictures."""
    is_full = ~one.is_silent
    for i, name in enumerate(FEATURES):
        if one.features.get(name):
            above = one.probabilities[:, i] > THRESHOLD
            # Without a sign or a light, no cue supports the presence of an intersection.
            is_full &= (above | one.established) if name == "intersection" else above
    places = np.flatnonzero(held(is_full & np.isfinite(one.start_m), CONFIRM_FRAMES))
    return float(one.start_m[places[0]]) if len(places) else None


def _reached(one: DriveBelief) -> Reached:
    """Return the thresholds below which the drive's features are detected."""
    said = ~one.is_silent
    columns = dict(zip(FEATURES, one.probabilities[said].T, strict=True))
    is_there = one.features["intersection"]
    present = [name for name in FEATURES if is_there and one.features.get(name)]
    absent = [name for name in FEATURES if one.features.get(name) is False]
    return reached(columns, present, absent, one.established[said])


def _ways_first(one: DriveBelief) -> Flags:
    ways = (one.probabilities[:, 1:] > THRESHOLD).any(axis=1)
    return np.asarray(ways & (one.probabilities[:, 0] <= THRESHOLD) & ~one.is_silent)


def _of_pictures(beliefs: Sequence[DriveBelief], flags_of: Callable[[DriveBelief], Flags]) -> Mean:
    clusters = _clusters([one.layout for one in beliefs])
    flags = [flags_of(one) for one in beliefs]
    numbers = [
        np.full(len(one), number) for one, number in zip(flags, clusters.tolist(), strict=True)
    ]
    return _fraction(np.concatenate(flags), np.concatenate(numbers))


def _fraction(flags: Flags, clusters: Int64s) -> Mean:
    """Return ``mean`` with its interval limited to 0 to 1."""
    found = fraction(flags, clusters)
    return Mean(found.value, found.clusters_low, found.clusters_high, found.of, found.clusters)
