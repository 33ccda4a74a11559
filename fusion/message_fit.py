"""From annotated approaches to what ``fusion = "calibrated"`` needs: fades, rates and exponents.

* A cue's *fade* is the way (or the time, whichever explains its looks better) over which its
  residual, positive or not less the rate to be expected, stays like itself: least squares of
  exp(-distance / fade) on products of residuals at many lags.
* A *rate* is the share of positive looks where a feature is there, and where it is not, near and
  far; each look weighs what it is worth as an independent one. Both shares are pulled a little
  towards their common one (Laplace's rule with the pooled rate for a prior), so that few looks say
  that there is no difference.
* A feature's *exponent* is the factor on all its log odds, at most 1, that makes its log score over
  the annotated approaches best, each approach weighing the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.fusion_settings import Calibrated, Fade, Rates

from .belief import Situation
from .calibrated import USUAL_FADE, CalibratedSpeaker, voices_of
from .factor_graph import CueNode, FactorGraph, log_odds

NOT_LOOKED: Final = -1
LEAST_POSITIVES: Final = 20
"""Fewer positive looks do not tell a fade."""
LEAST_APPROACHES: Final = 3
"""With the feature and without, each; fewer do not tell a rate or an exponent."""
PULL_LOOKS: Final = 2.0
"""So many looks at the pooled rate are added to either side."""
LAGS: Final = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89)
WAYS_M: Final = np.geomspace(0.3, 100.0, 36)
TIMES_S: Final = np.geomspace(0.05, 20.0, 36)
EXPONENTS: Final = np.linspace(0.05, 1.0, 96)

Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class AnnotatedApproach:
    """N frames of one approach and what is true of its intersection.

    Attributes:
        way_m: Shape (N,), gone since its first frame, never falling.
        time_s: Shape (N,), likewise.
        is_near: Shape (N,): the intersection was known to be near.
        is_established: Shape (N,): its presence was, by earlier frames.
        counts: From cue to shape (N,): how many, or ``NOT_LOOKED``.
        features: Which are there, and which are not; one not named is not known.
    """

    way_m: Floats
    time_s: Floats
    is_near: Bools
    is_established: Bools
    counts: Mapping[str, Int64s]
    features: Mapping[str, bool]

    def looks(self, cue: CueNode) -> Int64s:
        """Frames in which the cue was looked for and would speak."""
        count = self.counts.get(cue.name)
        if count is None:
            return np.empty(0, np.int64)
        speaks = (count != NOT_LOOKED) & (self.is_established | cue.speaks_first)
        return np.flatnonzero(speaks).astype(np.int64)


class FadeFit(NamedTuple):
    """A cue's fade; ``is_learned`` is false where the usual one stands in."""

    cue: str
    fade: Fade
    positives: int
    looks: int
    is_learned: bool


class Side(NamedTuple):
    """One side of a rate.

    Attributes:
        approaches: With at least one look.
        frames: Looks as they are.
        looks: What they are worth as independent ones.
        hits: Likewise of the positive ones.
    """

    approaches: int
    frames: int
    looks: float
    hits: float


class RateFit(NamedTuple):
    """An edge's rates near or far; None where too little was seen to tell."""

    cue: str
    feature: str
    near: bool
    there: Side
    missing: Side
    rates: Rates | None


@dataclass(frozen=True, slots=True)
class MessageFit:
    """All that was learned.

    Attributes:
        calibrated: For the vehicle file.
        fades: By cue, in the graph's order.
        rates: By edge, near and far.
        approaches: How many there were.
    """

    calibrated: Calibrated
    fades: tuple[FadeFit, ...]
    rates: tuple[RateFit, ...]
    approaches: int


def fit_messages(approaches: Sequence[AnnotatedApproach], graph: FactorGraph) -> MessageFit:
    """Learn fades, then rates with them, then exponents with both."""
    fades = tuple(_fade(approaches, graph, cue) for cue in graph.cues)
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


def _fade(approaches: Sequence[AnnotatedApproach], graph: FactorGraph, cue: CueNode) -> FadeFit:
    residuals = _residuals(approaches, graph, cue)
    looks = sum(len(one) for one, _ in residuals)
    positives = sum(
        int((approach.counts[cue.name][rows] > 0).sum())
        for approach, (rows, _) in zip(approaches, residuals, strict=True)
        if len(rows)
    )
    parts = [
        (approach.way_m[rows], approach.time_s[rows], residual)
        for approach, (rows, residual) in zip(approaches, residuals, strict=True)
    ]
    ways, times, products = _pairs(parts)
    squares = np.concatenate([residual**2 for _, residual in residuals]) if looks else np.zeros(1)
    variance = float(squares.mean())
    if positives < LEAST_POSITIVES or variance == 0.0 or not len(products):
        return FadeFit(cue.name, USUAL_FADE, positives, looks, False)
    way_m, way_misfit = _best(ways, products / variance, WAYS_M)
    time_s, time_misfit = _best(times, products / variance, TIMES_S)
    fade = Fade(way_m=way_m) if way_misfit <= time_misfit else Fade(time_s=time_s)
    return FadeFit(cue.name, fade, positives, looks, True)


def _residuals(
    approaches: Sequence[AnnotatedApproach], graph: FactorGraph, cue: CueNode
) -> list[tuple[Int64s, Floats]]:
    """Looks of each approach, and positive (1) or not (0) less the rate among looks alike."""
    ends = [edge.feature for edge in graph.edges if edge.cue == cue.name]
    rows = [approach.looks(cue) for approach in approaches]
    groups: dict[tuple[object, ...], list[tuple[int, Bools]]] = {}
    positive = [
        (approach.counts[cue.name][at] > 0).astype(np.float64) if len(at) else np.empty(0)
        for approach, at in zip(approaches, rows, strict=True)
    ]
    for i, (approach, at) in enumerate(zip(approaches, rows, strict=True)):
        for near in (False, True):
            alike = approach.is_near[at] == near
            key = (near, *(approach.features.get(feature) for feature in ends))
            groups.setdefault(key, []).append((i, alike))
    residuals = [values.copy() for values in positive]
    for members in groups.values():
        total = sum(int(alike.sum()) for _, alike in members)
        rate = sum(float(positive[i][alike].sum()) for i, alike in members) / max(total, 1)
        for i, alike in members:
            residuals[i][alike] -= rate
    return list(zip(rows, residuals, strict=True))


def _pairs(parts: Sequence[tuple[Floats, Floats, Floats]]) -> tuple[Floats, Floats, Floats]:
    """Way, time and product of residuals between looks of one approach, at all lags."""
    found: list[tuple[Floats, Floats, Floats]] = [(np.empty(0), np.empty(0), np.empty(0))]
    for way_m, time_s, residual in parts:
        for lag in LAGS:
            if lag < len(residual):
                found.append(
                    (way_m[lag:] - way_m[:-lag], time_s[lag:] - time_s[:-lag],
                     residual[lag:] * residual[:-lag])
                )  # fmt: skip
    ways, times, products = (np.concatenate(columns) for columns in zip(*found, strict=True))
    return ways, times, products


def _best(distance: Floats, correlation: Floats, scales: Floats) -> tuple[float, float]:
    """The scale whose exp(-distance / scale) fits best, and the mean square that is left."""
    misfits = [float(np.mean((correlation - np.exp(-distance / s)) ** 2)) for s in scales.tolist()]
    best = int(np.argmin(misfits))
    return float(scales[best]), misfits[best]


def _rate(
    approaches: Sequence[AnnotatedApproach], cue: CueNode, feature: str, near: bool, fade: Fade
) -> RateFit:
    there = _side([a for a in approaches if a.features.get(feature) is True], cue, near, fade)
    missing = _side([a for a in approaches if a.features.get(feature) is False], cue, near, fade)
    rates = None
    if min(there.approaches, missing.approaches) >= LEAST_APPROACHES:
        looks = there.looks + missing.looks
        pooled = (there.hits + missing.hits + 1.0) / (looks + 2.0)
        if_there, if_not = (
            (side.hits + PULL_LOOKS * pooled) / (side.looks + PULL_LOOKS)
            for side in (there, missing)
        )
        rates = Rates(cue=cue.name, feature=feature, near=near, if_there=if_there, if_not=if_not)
    return RateFit(cue.name, feature, near, there, missing, rates)


def _side(approaches: Sequence[AnnotatedApproach], cue: CueNode, near: bool, fade: Fade) -> Side:
    seen = frames = 0
    looks = hits = 0.0
    for approach in approaches:
        rows = approach.looks(cue)
        alike = rows[approach.is_near[rows] == near]
        if not len(alike):
            continue
        at = approach.time_s[rows] / fade.time_s if fade.time_s else (
            approach.way_m[rows] / (fade.way_m or np.inf)
        )  # fmt: skip
        worth = np.concatenate([[1.0], np.tanh(0.5 * np.diff(at))])[approach.is_near[rows] == near]
        seen += 1
        frames += len(alike)
        looks += float(worth.sum())
        hits += float(worth[approach.counts[cue.name][alike] > 0].sum())
    return Side(seen, frames, looks, hits)


def _exponents(
    approaches: Sequence[AnnotatedApproach], graph: FactorGraph, learned: Calibrated
) -> dict[str, float]:
    sums = [log_odds_of(approach, graph, learned) for approach in approaches]
    out: dict[str, float] = {}
    for place, feature in enumerate(graph.features):
        truths = [approach.features.get(feature.name) for approach in approaches]
        if min(truths.count(True), truths.count(False)) < LEAST_APPROACHES:
            continue
        prior = log_odds(feature.prior)
        loss = np.zeros(len(EXPONENTS))
        for is_there, odds in zip(truths, sums, strict=True):
            if is_there is not None and len(odds):
                away = prior + EXPONENTS[:, None] * odds[None, :, place]
                loss += np.logaddexp(0.0, -away if is_there else away).mean(axis=1)
        out[feature.name] = round(float(EXPONENTS[int(np.argmin(loss))]), 3)
    return out


def log_odds_of(approach: AnnotatedApproach, graph: FactorGraph, learned: Calibrated) -> Floats:
    """Sums of messages after each frame, without the prior, shape (N, features)."""
    speaker = CalibratedSpeaker(len(graph.features), voices_of(graph, learned))
    messages = [speaker(situation) for situation in _situations(approach)]
    return np.cumsum(np.array(messages).reshape(-1, len(graph.features)), axis=0)


def _situations(approach: AnnotatedApproach) -> Iterator[Situation]:
    columns = {name: count.tolist() for name, count in approach.counts.items()}
    moved = np.diff(approach.way_m, prepend=approach.way_m[:1]).tolist()
    passed = np.diff(approach.time_s, prepend=approach.time_s[:1]).tolist()
    near, established = approach.is_near.tolist(), approach.is_established.tolist()
    for i in range(len(moved)):
        counts = {name: column[i] for name, column in columns.items() if column[i] != NOT_LOOKED}
        yield Situation(counts, established[i], near[i], moved_m=moved[i], passed_s=passed[i])
