"""Fit a cue's fade: the distance or time over which its observations become independent.

The autocorrelation of a cue's residual (positive or not, minus the expected rate) is modelled as
``always + fading * exp(-distance / scale)``; the rest is noise of single observations. ``always``
is the constant error of a place. The curve is fitted by least squares to products of residuals at
many lags, once over distance and once over time; the better fit is used. The fade is the curve's
integral over an approach's length. It is the scale of the single exponential that yields the same
number of independent observations.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.fusion.factor_graph import USUAL_FADE, CueNode, FactorGraph
from crosscue.fusion.fit.annotated_approach import AnnotatedApproach, Bools
from crosscue.replay.vehicle.fusion import Fade

# Minimum number of positive observations for a fit.
MIN_POSITIVES: Final = 20
LAGS: Final = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89)
WAYS_M: Final = np.geomspace(0.3, 100.0, 36)
TIMES_S: Final = np.geomspace(0.05, 20.0, 36)
BINS: Final = 60


class FadeFit(NamedTuple):
    """A cue's fade; ``is_learned`` is False for the default."""

    cue: str
    fade: Fade
    positives: int
    observations: int
    is_learned: bool


class Binned(NamedTuple):
    """Autocorrelations of residuals in bins of distance, as columns of equal length.

    Attributes:
        pairs: Number of pairs in each bin.
        distance: Mean distance, in metres or seconds.
        correlation: Mean product of residuals over their variance.
    """

    pairs: NDArray[np.float64]
    distance: NDArray[np.float64]
    correlation: NDArray[np.float64]


def fit_fade(approaches: Sequence[AnnotatedApproach], graph: FactorGraph, cue: CueNode) -> FadeFit:
    """Fit a cue's fade; with too few positive observations, the default is returned."""
    residuals = _residuals(approaches, graph, cue)
    observations, positives, squares = 0, 0, 0.0
    ways, times, products = [np.empty(0)], [np.empty(0)], [np.empty(0)]
    spans: list[tuple[float, float]] = []
    for approach, (rows, residual) in zip(approaches, residuals, strict=True):
        if not len(rows):
            continue
        way_m, time_s = approach.way_m[rows], approach.time_s[rows]
        observations += len(rows)
        positives += int((approach.counts[cue.name][rows] > 0).sum())
        squares += float((residual**2).sum())
        spans.append((float(way_m[-1] - way_m[0]), float(time_s[-1] - time_s[0])))
        for lag in LAGS[: int(np.searchsorted(LAGS, len(rows)))]:
            ways.append(way_m[lag:] - way_m[:-lag])
            times.append(time_s[lag:] - time_s[:-lag])
            products.append(residual[lag:] * residual[:-lag])
    correlation = np.concatenate(products)
    if positives < MIN_POSITIVES or squares == 0.0 or not len(correlation):
        return FadeFit(cue.name, USUAL_FADE, positives, observations, False)
    correlation *= observations / squares
    length_m, length_s = np.mean(spans, axis=0).tolist()
    way, way_misfit = _integral(_binned(np.concatenate(ways), correlation), WAYS_M, length_m)
    time, time_misfit = _integral(_binned(np.concatenate(times), correlation), TIMES_S, length_s)
    fade = Fade(way_m=way) if way_misfit <= time_misfit else Fade(time_s=time)
    return FadeFit(cue.name, fade, positives, observations, True)


def _residuals(
    approaches: Sequence[AnnotatedApproach], graph: FactorGraph, cue: CueNode
) -> list[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Rows of each approach's observations, and residuals from the rate in similar situations."""
    ends = [edge.feature for edge in graph.edges if edge.cue == cue.name]
    rows = [approach.observed(cue) for approach in approaches]
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


def _binned(distance: NDArray[np.float64], correlation: NDArray[np.float64]) -> Binned:
    """Divide pairs into bins of equal number; equal distances are in the same bin."""
    edges = np.unique(np.quantile(distance, np.linspace(0.0, 1.0, BINS + 1)))
    which = np.searchsorted(edges, distance, side="right")
    pairs = np.bincount(which).astype(np.float64)
    some = pairs > 0.0
    return Binned(
        pairs[some],
        np.bincount(which, distance)[some] / pairs[some],
        np.bincount(which, correlation)[some] / pairs[some],
    )


def _integral(binned: Binned, scales: NDArray[np.float64], length: float) -> tuple[float, float]:
    """Integral of the best curve over ``length``, and its squared error up to a constant."""
    best, lowest = float(scales[0]), float("inf")
    for scale in scales.tolist():
        shape = np.exp(-binned.distance / scale)
        always, fading = _line(shape, binned)
        curve = always + fading * shape
        misfit = float((binned.pairs * curve * (curve - 2.0 * binned.correlation)).sum())
        if misfit < lowest:
            lowest = misfit
            best = always * length + fading * scale * -float(np.expm1(-length / scale))
    return max(best, float(scales[0])), lowest


def _line(shape: NDArray[np.float64], binned: Binned) -> tuple[float, float]:
    """Fit ``always + fading * shape`` by least squares, with both between 0 and 1."""
    weight = binned.pairs / binned.pairs.sum()
    middle, level = float(weight @ shape), float(weight @ binned.correlation)
    spread = float(weight @ (shape - middle) ** 2)
    fading = 0.0
    if spread > 0.0:
        fading = float(weight @ ((shape - middle) * (binned.correlation - level))) / spread
    always = level - fading * middle
    if always < 0.0:
        always = 0.0
        fading = float(weight @ (shape * binned.correlation)) / float(weight @ shape**2)
    return min(always, 1.0), min(max(fading, 0.0), 1.0)
