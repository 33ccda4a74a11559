"""Score the beliefs of the study of layouts, with intervals over layouts.

Every picture counts, so that all beliefs are scored on the same pictures.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.scoring.intervals import Mean, fraction, mean
from crosscue.eval.scoring.scene.belief import brier, log_score
from crosscue.eval.scoring.scene.detection import CONFIRM_FRAMES, held
from crosscue.eval.scoring.scene.trade import Reached, TradePoint, reached, trade_off
from crosscue.eval.scoring.truth import FEATURES
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


# Values of one drive, by picture or one for the drive; flags are fractions.
Metric = Callable[[DriveBelief], Any]


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
    return LayoutScore(
        **{name: _over_layouts(beliefs, of) for name, of in METRICS.items()},
        brier_by_feature={
            name: _over_layouts(beliefs, partial(_of_features, brier, only=name))
            for name in FEATURES
        },
        trade=trade_off([_reached(one) for one in beliefs], _clusters(beliefs)),
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
    pairs = list(zip(first, second, strict=True))

    def less(of: Metric) -> Mean:
        return _mean(first, [of(after) - of(before) for before, after in pairs])

    return LayoutDifference(*(less(METRICS[one.name]) for one in fields(LayoutDifference)))


def _over_layouts(beliefs: Sequence[DriveBelief], of: Metric) -> Mean:
    return _mean(beliefs, [of(one) for one in beliefs])


def _mean(beliefs: Sequence[DriveBelief], values: Sequence[Any]) -> Mean:
    """Return the mean with its interval over layouts, for flags limited to 0 to 1."""
    clusters = np.repeat(_clusters(beliefs), [len(some) for some in values])
    every = np.concatenate(values)
    if every.dtype != np.bool_:
        return mean(every, clusters)
    found = fraction(every.astype(np.bool_), clusters)
    return Mean(found.value, found.clusters_low, found.clusters_high, found.of, found.clusters)


def _clusters(beliefs: Sequence[DriveBelief]) -> Int64s:
    numbers = {name: i for i, name in enumerate(dict.fromkeys(one.layout for one in beliefs))}
    return np.array([numbers[one.layout] for one in beliefs], np.int64)


def _of_features(
    score: Callable[[Floats, Flags], Floats], one: DriveBelief, only: str | None = None
) -> Floats:
    """Return the scores of pictures, feature after feature, where the truth is known."""
    known = [(i, name) for i, name in enumerate(FEATURES) if name in one.features]
    n = len(one.probabilities)
    found = [
        score(one.probabilities[:, i], np.full(n, one.features[name]))
        for i, name in known
        if only in (None, name)
    ]
    return np.concatenate([np.empty(0), *found])


def _false_features(one: DriveBelief) -> Floats:
    above = np.any(one.probabilities[~one.is_silent] > THRESHOLD, axis=0)
    absent = [i for i, name in enumerate(FEATURES) if one.features.get(name) is False]
    return np.array([above[absent].sum()], np.float64)


def _full_m(one: DriveBelief) -> Floats:
    """Return where all present features are believed for several pictures; NaN for never."""
    if not one.features["intersection"]:
        return np.empty(0)
    is_full = ~one.is_silent
    for i, name in enumerate(FEATURES):
        if one.features.get(name):
            above = one.probabilities[:, i] > THRESHOLD
            # Without a sign or a light, no cue supports the presence of an intersection.
            is_full &= (above | one.established) if name == "intersection" else above
    places = np.flatnonzero(held(is_full & np.isfinite(one.start_m), CONFIRM_FRAMES))
    return one.start_m[places[:1]] if len(places) else np.array([np.nan])


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


# Value of each picture or drive of one belief, by field of ``LayoutScore``.
METRICS: Final[Mapping[str, Metric]] = {
    "brier": partial(_of_features, brier),
    "log_score": partial(_of_features, log_score),
    "false_features": _false_features,
    "full": lambda one: np.isfinite(_full_m(one)),
    "full_m": _full_m,
    "full_before_detected": _ways_first,
    "silent": lambda one: one.is_silent,
}
