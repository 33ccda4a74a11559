"""Change points of metrics in a history of versions, judged drive by drive.

If nothing changed, the assignment of a drive's results to versions is arbitrary. Shuffling the
results of each drive among its versions, alike for all drives of a place, therefore yields the
distribution, under chance alone, of the difference between the versions before and after a split.
This is the permutation test of ``crosscue compare``, for more than two versions. The difference at
a split is the mean over drives, weighted by their rows, in units of its standard deviation. The
test uses the largest difference over all splits and metrics (Westfall, Young, *Resampling-Based
Multiple Testing*, 1993). If it exceeds that of 95 % of the shuffles, the split is a change point,
and the parts before and after it are searched together in the same way (binary segmentation;
Vostrikova, *Soviet Mathematics Doklady* 24, 1981). Hence a history without changes shows a change
point in at most 5 % of cases, and so does each further round of the search. Finally, each change
point is tested again between its neighbors, and dropped if they explain it.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Floats, Int64s

from .intervals import MIN_CLUSTERS

FALSE_ALARMS: Final = 0.05
SHUFFLES: Final = 1000
SEED: Final = 0
ROUNDING: Final = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """Results of G drives with V versions, for one metric.

    Attributes:
        values: Shape (G, V); NaN where a drive has no result.
        weights: Shape (G,): numbers of rows behind a drive's values.
        places: Shape (G,): number of each drive's place.
    """

    values: Floats
    weights: Floats
    places: Int64s


@dataclass(frozen=True, slots=True, order=True)
class ChangePoint:
    """A change of one metric.

    Attributes:
        at: Index of the first version that differs from those before.
        p: Probability that any metric differs as much at any split by chance.
        by: Value after minus value before, up to the neighboring change points; mean over the
            drives on both sides.
    """

    at: int
    p: float
    by: float


def change_points(results: Mapping[str, Results]) -> dict[str, tuple[ChangePoint, ...]]:
    """Return the change points of every metric, in order of versions.

    Args:
        results: Results by metric, all with the same drives and versions.
    """
    found: dict[str, list[ChangePoint]] = {name: [] for name in results}
    spans = [_Span(name, 0, one.values.shape[1]) for name, one in results.items()]
    while spans:
        points = list(_found_in(spans, results))
        for span, point in points:
            found[span.name].append(point)
        spans = [
            half
            for span, point in points
            for half in (replace(span, end=point.at), replace(span, first=point.at))
        ]
    return {name: _confirmed(sorted(points), results[name]) for name, points in found.items()}


def _confirmed(points: Sequence[ChangePoint], one: Results) -> tuple[ChangePoint, ...]:
    """Return the points that are significant between their neighbors.

    The first split of a search may be next to a change.
    """
    edges = [0, *(point.at for point in points), one.values.shape[1]]
    kept = []
    for i, point in enumerate(points):
        first, end = edges[i], edges[i + 2]
        differences = _differences(one.values[:, first:end], one)
        if differences is None:
            continue
        of_split = differences[:, point.at - first - 1]
        far = abs(of_split[0]) * (1.0 - ROUNDING)
        if (np.abs(of_split) >= far).mean() <= FALSE_ALARMS:
            kept.append(replace(point, by=float(of_split[0])))
    return tuple(kept)


@dataclass(frozen=True, slots=True)
class _Span:
    """A span of versions of a metric, from ``first`` to ``end`` (exclusive)."""

    name: str
    first: int
    end: int


def _found_in(
    spans: Sequence[_Span], results: Mapping[str, Results]
) -> Iterator[tuple[_Span, ChangePoint]]:
    """Yield the most significant split of each span, if it is significant over all spans."""
    statistics = {}
    for span in spans:
        one = results[span.name]
        scaled = _statistics(one.values[:, span.first : span.end], one)
        if scaled is not None:
            statistics[span] = scaled
    if not statistics:
        return
    largest = np.max([one.max(axis=1) for one in statistics.values()], axis=0)
    for span, scaled in statistics.items():
        split = int(scaled[0].argmax())
        p = float((largest >= scaled[0, split] - ROUNDING).mean())
        if p <= FALSE_ALARMS:
            yield span, ChangePoint(span.first + split + 1, p, math.nan)


def _statistics(values: Floats, of: Results) -> Floats | None:
    """Return the difference at each split in standard deviations, for each shuffle.

    Shape (S, V - 1), the first row unshuffled; None if there are too few places, or
    no drive differs.
    """
    signed = _differences(values, of)
    if signed is None:
        return None
    differences = np.abs(signed)
    spread = np.sqrt((differences**2).mean(axis=0))
    if not (spread > ROUNDING).any():
        return None
    is_apart = spread > ROUNDING
    found: Floats = np.where(is_apart, differences, 0.0) / np.where(is_apart, spread, 1.0)
    return found


def _differences(values: Floats, of: Results) -> Floats | None:
    """Return the value after minus the value before each split, for each shuffle, (S, V - 1)."""
    is_known = np.isfinite(values)
    weight = _split_weights(is_known, of)
    if weight is None:
        return None
    shuffled = _shuffled(np.where(is_known, values, 0.0), is_known, of.places)
    found: Floats = np.tensordot(shuffled, weight, axes=([1, 2], [1, 2]))
    return found


def _split_weights(is_known: NDArray[np.bool_], of: Results) -> Floats | None:
    """Return the weight of each value in the difference at each split, shape (V - 1, G, V)."""
    versions, weights = is_known.shape[1], of.weights
    if versions < 2:
        return None
    place = np.arange(versions)
    whole = np.zeros((versions - 1, *is_known.shape))
    for split in range(1, versions):
        sides = [is_known & (place < split), is_known & (place >= split)]
        counts = [side.sum(axis=1) for side in sides]
        both = (counts[0] > 0) & (counts[1] > 0) & (weights > 0.0)
        if len(np.unique(of.places[both])) < MIN_CLUSTERS:
            continue
        fraction = np.where(both, weights, 0.0) / weights[both].sum()
        before, after = (
            side * (fraction / np.maximum(count, 1))[:, None]
            for side, count in zip(sides, counts, strict=True)
        )
        whole[split - 1] = after - before
    return whole if whole.any() else None


def _shuffled(values: Floats, is_known: NDArray[np.bool_], places: Int64s) -> Floats:
    """Shuffle each drive's values among its versions, shape (S, G, V), the first unshuffled.

    All metrics of all drives of a place are shuffled alike, to keep their dependence.
    """
    chance = np.random.default_rng(SEED)
    keys = chance.random((SHUFFLES, int(places.max()) + 1, values.shape[1]))[:, places]
    place = np.arange(values.shape[1])
    keys[0] = place
    # The keys of missing versions sort them to their own places.
    order = np.broadcast_to(place, keys.shape).copy()
    for drive, known in enumerate(is_known):
        there = np.flatnonzero(known)
        order[:, drive, there] = there[np.argsort(keys[:, drive, there], axis=1)]
    drives = np.arange(len(values))[None, :, None]
    found: Floats = values[drives, order]
    return found
