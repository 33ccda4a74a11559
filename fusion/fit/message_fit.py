"""Fit the parameters of ``fusion = "calibrated"`` to annotated approaches.

* A cue's *fade* determines the number of independent observations in an approach; see ``fade_fit``.
* A *rate* is the fraction of positive observations with a feature, and without it, near and far.
  Each frame is weighted by its independence, and all places equally, because a thousand frames at
  three intersections are little evidence about a fourth. Both rates are shrunk towards their common
  rate by one additional place (Laplace's rule with the pooled rate as prior), so that few places
  yield little difference.
* A feature's *exponent* is the factor on all its log odds, at most 1, with the best log score over
  the annotated places, all of equal weight. A weak log-normal prior about 1, of unit width,
  prevents a few places from disabling a feature.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.fusion.calibrated import CalibratedMessageModel, cue_messages_of
from crosscue.fusion.factor_graph import CueNode, FactorGraph, log_odds
from crosscue.fusion.fit.annotated_approach import NOT_EVALUATED, AnnotatedApproach
from crosscue.fusion.fit.fade_fit import FadeFit, fit_fade
from crosscue.fusion.situation import Situation
from crosscue.replay.vehicle.fusion import Calibrated, Fade, Rates

# Minimum number of places with the feature, and of places without it, for a rate or exponent. A
# rate also requires this number of places where the cue was positive; otherwise only the published
# message is known.
MIN_PLACES: Final = 3
# Number of places at the pooled rate that are added to either side.
PULL_PLACES: Final = 1.0
EXPONENTS: Final = np.linspace(0.05, 1.0, 96)


class Side(NamedTuple):
    """One side of a rate.

    Attributes:
        rates: Fraction of positive frames at each place with observations.
        frames: Number of frames.
        observations: Number of independent observations to which the frames are equivalent.
        hits: Number of independent observations to which the positive frames are equivalent.
    """

    rates: tuple[float, ...]
    frames: int
    observations: float
    hits: float

    @property
    def places(self) -> int:
        """Number of places with at least one observation."""
        return len(self.rates)


class RateFit(NamedTuple):
    """An edge's rates near or far; None with too few observations."""

    cue: str
    feature: str
    near: bool
    there: Side
    missing: Side
    rates: Rates | None


@dataclass(frozen=True, slots=True)
class MessageFit:
    """Result of the fit.

    Attributes:
        calibrated: Section of the vehicle file.
        fades: Fade of each cue, in the graph's order.
        rates: Rates of each edge, near and far.
        approaches: Number of approaches.
    """

    calibrated: Calibrated
    fades: tuple[FadeFit, ...]
    rates: tuple[RateFit, ...]
    approaches: int


def fit_messages(approaches: Sequence[AnnotatedApproach], graph: FactorGraph) -> MessageFit:
    """Fit fades, then rates with these fades, then exponents with both."""
    fades = tuple(fit_fade(approaches, graph, cue) for cue in graph.cues)
    known = {one.cue: one.fade for one in fades}
    rates = tuple(
        _rate(approaches, cue, edge.feature, near, known[cue.name])
        for cue in graph.cues
        for edge in graph.edges
        if edge.cue == cue.name
        for near in (False, True)
    )
    learned = Calibrated(
        fades={one.cue: one.fade for one in fades if one.is_learned},
        rates=tuple(one.rates for one in rates if one.rates is not None),
    )
    exponents = _exponents(approaches, graph, learned)
    return MessageFit(
        learned.model_copy(update={"exponents": exponents}), fades, rates, len(approaches)
    )


def _rate(
    approaches: Sequence[AnnotatedApproach], cue: CueNode, feature: str, near: bool, fade: Fade
) -> RateFit:
    there = _side([a for a in approaches if a.features.get(feature) is True], cue, near, fade)
    missing = _side([a for a in approaches if a.features.get(feature) is False], cue, near, fade)
    rates = None
    seen = (*there.rates, *missing.rates)
    positive = sum(rate > 0.0 for rate in seen)
    if min(there.places, missing.places, positive) >= MIN_PLACES:
        pooled = (sum(seen) + 0.5) / (len(seen) + 1.0)
        if_there, if_not = (
            (sum(side.rates) + PULL_PLACES * pooled) / (side.places + PULL_PLACES)
            for side in (there, missing)
        )
        rates = Rates(cue=cue.name, feature=feature, near=near, if_there=if_there, if_not=if_not)
    return RateFit(cue.name, feature, near, there, missing, rates)


def _side(approaches: Sequence[AnnotatedApproach], cue: CueNode, near: bool, fade: Fade) -> Side:
    totals: dict[str, tuple[float, float]] = {}
    frames = 0
    for approach in approaches:
        rows = approach.observed(cue)
        alike = approach.is_near[rows] == near
        if not alike.any():
            continue
        at = (
            approach.time_s[rows] / fade.time_s
            if fade.time_s
            else (approach.way_m[rows] / (fade.way_m or np.inf))
        )
        worth = np.concatenate([[1.0], np.tanh(0.5 * np.diff(at))])[alike]
        is_positive = approach.counts[cue.name][rows][alike] > 0
        observations, hits = totals.get(approach.place, (0.0, 0.0))
        totals[approach.place] = (
            observations + float(worth.sum()),
            hits + float(worth[is_positive].sum()),
        )
        frames += len(worth)
    kept = [(observations, hits) for observations, hits in totals.values() if observations > 0.0]
    return Side(
        tuple(hits / observations for observations, hits in kept),
        frames,
        sum(observations for observations, _ in kept),
        sum(hits for _, hits in kept),
    )


def _exponents(
    approaches: Sequence[AnnotatedApproach], graph: FactorGraph, learned: Calibrated
) -> dict[str, float]:
    sums = [log_odds_of(approach, graph, learned) for approach in approaches]
    out: dict[str, float] = {}
    for column, feature in enumerate(graph.features):
        sides: dict[bool, set[str]] = {True: set(), False: set()}
        losses: dict[str, list[NDArray[np.float64]]] = {}
        for approach, odds in zip(approaches, sums, strict=True):
            is_there = approach.features.get(feature.name)
            if is_there is not None and len(odds):
                sides[is_there].add(approach.place)
                away = log_odds(feature.prior) + EXPONENTS[:, None] * odds[None, :, column]
                loss = np.logaddexp(0.0, -away if is_there else away).mean(axis=1)
                losses.setdefault(approach.place, []).append(loss)
        if min(map(len, sides.values())) >= MIN_PLACES:
            total = sum(np.mean(some, axis=0) for some in losses.values())
            best = int(np.argmin(total + 0.5 * np.log(EXPONENTS) ** 2))
            out[feature.name] = round(float(EXPONENTS[best]), 3)
    return out


def log_odds_of(
    approach: AnnotatedApproach, graph: FactorGraph, learned: Calibrated
) -> NDArray[np.float64]:
    """Sum of messages after each frame, without the prior, shape (N, features)."""
    model = CalibratedMessageModel(len(graph.features), cue_messages_of(graph, learned))
    messages = [model(situation) for situation in _situations(approach)]
    return np.cumsum(np.array(messages).reshape(-1, len(graph.features)), axis=0)


def _situations(approach: AnnotatedApproach) -> Iterator[Situation]:
    columns = {name: count.tolist() for name, count in approach.counts.items()}
    moved = np.diff(approach.way_m, prepend=approach.way_m[:1]).tolist()
    passed = np.diff(approach.time_s, prepend=approach.time_s[:1]).tolist()
    near, established = approach.is_near.tolist(), approach.is_established.tolist()
    for i in range(len(moved)):
        counts = {name: column[i] for name, column in columns.items() if column[i] != NOT_EVALUATED}
        yield Situation(counts, established[i], near[i], moved_m=moved[i], passed_s=passed[i])
