"""Paired comparison of two runs' metrics over drives: better, worse or undecided.

If both runs are equally good, it is arbitrary which of a drive's two results came from which run.
Swapping them at random shows how far metrics differ by chance (a permutation test; Good,
*Permutation, Parametric and Bootstrap Tests of Hypotheses*, chapter 3). Drives of one place are not
independent: what helps in one drive there helps in the next. They are therefore swapped together.

Many cues under many conditions are many chances for a false alarm. They are corrected by Holm's
procedure (*Scandinavian Journal of Statistics* 6, 1979) with the joint distribution of the swaps in
place of Bonferroni's bound (Westfall, Young, *Resampling-Based Multiple Testing*, 1993, algorithm
4.1): starting with the metric that differs most in units of its own spread, each is judged by the
largest difference over the remaining ones. A metric that did not change is therefore called better
or worse in at most 5 % of comparisons, for any number of metrics, any dependence between them, and
any change of the others. Benjamini and Hochberg's procedure decides more, but allows 5 % of its
verdicts to be false, which is too many for a gate that fails on a single one.

A repetition draws the effects of as many places as there are on all metrics, and adds a difference
to one of them. Effects are normal, with the covariance of the places' effects between metrics; as
few places determine a scale poorly, each repetition draws one (chi-squared). The test is that of
``paired``: its swaps, its correction for all metrics, and its interval. Effects are linear (the
jackknife's), and all other metrics are unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.scoring.by_drive import Direction, DriveMetric, Kind, direction
from crosscue.eval.scoring.intervals import MIN_CLUSTERS
from crosscue.eval.scoring.places import group_drives
from crosscue.replay.columns import Floats, Int64s

# Max fraction of comparisons in which any unchanged metric gets a verdict.
FALSE_ALARMS: Final = 0.05
# Above this, the number of places that would decide is not printed.
MAX_PLACES: Final = 1_000_000
FIXED_POINT_STEPS: Final = 6
EXACT_PLACES: Final = 12
SWAPS: Final = 1 << EXACT_PLACES
SEED: Final = 0
ROUNDING: Final = 1e-9

Verdict = Literal["better", "worse", "undecided", "too few places"]

REPETITIONS: Final = 200
# Max swaps per repetition.
TRIED: Final = 512
POWER: Final = 0.8
# Halvings of the interval in which the difference is searched, and its doublings before.
HALVINGS: Final = 10
DOUBLINGS: Final = 8


class Tolerance(NamedTuple):
    """Allowed loss of the metrics that match a pattern, absolute or relative to the first run."""

    pattern: str
    by: float
    is_fraction: bool

    def allowed(self, before: float) -> float:
        """Return the allowed loss in the metric's own unit."""
        return self.by * abs(before) if self.is_fraction else self.by


NONE: Final = Tolerance("*", 0.0, False)


@dataclass(frozen=True, slots=True)
class PairedMetric:
    """One metric over the drives that both runs have.

    Attributes:
        path: Path of the metric, as in gates.
        before: Value in the first run.
        after: Value in the second run.
        better: Good direction of the metric.
        drives: Number of drives with rows in at least one run.
        places: Number of their places.
        low: Lower end of the 95 % interval of after minus before, over places; NaN below six.
        high: Upper end of the interval.
        p: p value, corrected for all metrics.
        could_see: The smallest loss that 80 % of simulated repetitions find (``power``); infinite
            below six places.
        more_places: Number of additional places, as varied as these, with which 80 % of comparisons
            would detect a difference of this size; 0 if it is decided or zero, None if unknown.
        allowed: Allowed loss.
        verdict: Verdict on the second run.
    """

    path: str
    before: float
    after: float
    better: Direction
    drives: int
    places: int
    low: float
    high: float
    p: float
    could_see: float
    more_places: int | None
    allowed: float
    verdict: Verdict


class _Sums(NamedTuple):
    """Totals and numbers of rows by drive or place in the first and second run, shapes (G,)."""

    total: NDArray[np.float64]
    rows: NDArray[np.float64]
    other_total: NDArray[np.float64]
    other_rows: NDArray[np.float64]


def compare_drives(
    first: Sequence[DriveMetric],
    second: Sequence[DriveMetric],
    tolerances: Sequence[Tolerance] = (),
) -> tuple[PairedMetric, ...]:
    """Compare every judged metric that both runs have, over the drives that both have.

    Args:
        first: Contributions of drives to the metrics of the reference run.
        second: The same for the run to judge.
        tolerances: The last one whose pattern matches a metric applies; if none does, no loss is
            allowed.
    """
    logs = sorted({one.log for one in first} & {one.log for one in second})
    kinds: dict[str, Kind] = {one.metric: one.kind for one in (*first, *second)}
    known = {one.metric for one in first} & {one.metric for one in second}
    paths = [path for path in kinds if path in known and direction(path) is not None]
    found = _sums(logs, first, second)
    drives = {path: found[path] for path in paths if path in found}
    drives = {path: one for path, one in drives.items() if one.rows.any() and one.other_rows.any()}
    at = _places(logs, first, second)
    sums = {path: _Sums(*(by_place(column, at) for column in one)) for path, one in drives.items()}
    swaps = _swaps(len(np.unique(at)))
    spread = {path: _swapped(kinds[path], one, swaps) for path, one in sums.items()}
    units = {path: float(np.sqrt(np.mean(one**2))) for path, one in spread.items()}
    differing = [path for path in sums if units[path] > 0.0]
    scaled = np.array([np.abs(spread[path]) / units[path] for path in differing])
    p = step_down(scaled.reshape(len(differing), len(swaps)))
    p_of = dict(zip(differing, map(float, p), strict=True))
    effects = {path: _effects(path, kinds[path], one) for path, one in sums.items()}
    enough = {
        path: one
        for path, one in effects.items()
        if one.residuals.any() and np.count_nonzero(one.weights) >= MIN_CLUSTERS
    }
    could_see = detectable(enough, swaps)
    return tuple(
        _judged(
            path,
            kinds[path],
            sums[path],
            _Test(
                effects[path],
                int(((one.rows > 0.0) | (one.other_rows > 0.0)).sum()),
                p_of.get(path, 1.0),
                could_see.get(path, math.inf),
            ),
            tolerances,
        )
        for path, one in drives.items()
    )


def _places(
    logs: Sequence[str], first: Sequence[DriveMetric], second: Sequence[DriveMetric]
) -> Int64s:
    """Return the number of the place of each log; an unknown place is the log's own."""
    found: dict[str, set[str]] = {log: set() for log in logs}
    for one in (*first, *second):
        if one.log in found:
            found[one.log].update(one.places)
    return group_drives([sorted(found[log]) or [f"log {log}"] for log in logs])


def by_place(values: NDArray[np.float64], at: Int64s) -> NDArray[np.float64]:
    """Return the sums of the drives' values, shape (N, ...), at each place, shape (places, ...)."""
    found = np.zeros((int(at.max()) + 1 if len(at) else 0, *values.shape[1:]))
    np.add.at(found, at, values)
    return found


def step_down(statistics: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return p values corrected for all metrics, shape (M,).

    Args:
        statistics: Shape (M, S), of M metrics under S swaps, each in units of its own spread. The
            first column is the observation.
    """
    metrics = len(statistics)
    if not metrics:
        return np.ones(0)
    order = np.argsort(-statistics[:, 0], kind="stable")
    ordered = statistics[order]
    # Maximum over each metric and all metrics that differ less.
    largest = np.maximum.accumulate(ordered[::-1], axis=0)[::-1]
    corrected = np.empty(metrics)
    is_reached = largest >= ordered[:, :1] - ROUNDING
    corrected[order] = np.maximum.accumulate(is_reached.mean(axis=1))
    return corrected


def _sums(
    logs: Sequence[str], first: Sequence[DriveMetric], second: Sequence[DriveMetric]
) -> dict[str, _Sums]:
    """Return each drive's contributions in both runs, by metric."""
    place = {log: i for i, log in enumerate(logs)}
    columns: dict[str, NDArray[np.float64]] = {}
    for side, parts in enumerate((first, second)):
        for one in parts:
            if one.log in place:
                found = columns.setdefault(one.metric, np.zeros((4, len(logs))))
                found[2 * side : 2 * side + 2, place[one.log]] += one.total, one.rows
    return {path: _Sums(*found) for path, found in columns.items()}


def _swaps(places: int) -> NDArray[np.float64]:
    """Return swaps, shape (S, G): 1 if a place's results are swapped; the first row swaps none."""
    if places <= EXACT_PLACES:
        rows = np.arange(1 << places)[:, None]
        return (rows >> np.arange(places) & 1).astype(np.float64)
    drawn = np.random.default_rng(SEED).integers(0, 2, (SWAPS, places)).astype(np.float64)
    drawn[0] = 0.0
    return drawn


def _swapped(kind: Kind, sums: _Sums, swaps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return after minus before for every swap, shape (S,)."""
    total = swaps @ (sums.other_total - sums.total)
    rows = swaps @ (sums.other_rows - sums.rows)
    before = _value(kind, sums.total.sum() + total, sums.rows.sum() + rows)
    after = _value(kind, sums.other_total.sum() - total, sums.other_rows.sum() - rows)
    return np.nan_to_num(after - before)


def _value(
    kind: Kind, total: NDArray[np.float64], rows: NDArray[np.float64]
) -> NDArray[np.float64]:
    if kind == "sum":
        return total
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(rows > 0.5, total / rows, np.nan)
    return np.sqrt(np.maximum(mean, 0.0)) if kind == "rms" else mean


class _Test(NamedTuple):
    """What swaps of places say about one metric: effects, drives, p, and what could be seen."""

    effects: Effects
    drives: int
    p: float
    could_see: float


def _judged(
    path: str,
    kind: Kind,
    sums: _Sums,
    test: _Test,
    tolerances: Sequence[Tolerance],
) -> PairedMetric:
    effects, drives, p, could_see = test
    better = direction(path)
    assert better is not None
    before, after = _value_of(kind, sums.total, sums.rows), _value_of(kind, *sums[2:])
    difference = after - before
    places = int(np.count_nonzero(effects.weights))
    half = math.nan
    if is_enough := places >= MIN_CLUSTERS:
        squares = float((effects.residuals**2).sum())
        half = effects.half * math.sqrt(places / (places - 1) * squares)
    fitting = (one for one in reversed(tolerances) if fnmatchcase(path, one.pattern))
    allowed = next(fitting, NONE).allowed(before)
    verdict: Verdict = "undecided" if is_enough else "too few places"
    if p <= FALSE_ALARMS and half < abs(difference):
        if effects.sign * difference < 0.0:
            verdict = "better"
        elif abs(difference) - half > allowed:
            verdict = "worse"
    more: int | None = 0
    if difference != 0.0 and verdict not in ("better", "worse"):
        more = _more_places(could_see, difference, places)
    return PairedMetric(
        path=path,
        before=before,
        after=after,
        better=better,
        drives=drives,
        places=places,
        low=difference - half,
        high=difference + half,
        p=p,
        could_see=could_see,
        more_places=more,
        allowed=allowed,
        verdict=verdict,
    )


def _more_places(could_see: float, difference: float, places: int) -> int | None:
    """Return the additional places needed.

    The detectable difference falls as 1 / sqrt(places), and with the quantiles of Student's t.
    """
    if places < MIN_CLUSTERS:
        return MIN_CLUSTERS - places
    if not math.isfinite(could_see):
        return None
    enough = float(places)
    for _ in range(FIXED_POINT_STEPS):
        if enough > MAX_PLACES:
            return None
        quantiles = [_t(n - 1, 0.95) + _t(n - 1, 0.6) for n in (max(enough, MIN_CLUSTERS), places)]
        enough = places * (could_see * quantiles[0] / quantiles[1] / difference) ** 2
    return max(math.ceil(enough) - places, 1)


def _effects(path: str, kind: Kind, sums: _Sums) -> Effects:
    """Return the effect of each place on the difference, by the jackknife."""
    mine = (sums.rows > 0.0) | (sums.other_rows > 0.0)
    n = int(mine.sum())
    rows = np.where(mine, 0.5 * (sums.rows + sums.other_rows), 0.0)
    sign = -1.0 if direction(path) == "higher" else 1.0
    weights = mine / n if kind == "sum" else rows / rows.sum()
    if n < MIN_CLUSTERS:
        return Effects(np.zeros(len(mine)), weights, sign, math.nan)
    without = _value(
        kind, sums.other_total.sum() - sums.other_total, sums.other_rows.sum() - sums.other_rows
    ) - _value(kind, sums.total.sum() - sums.total, sums.rows.sum() - sums.rows)
    scale = 1.0 if kind == "sum" else (n - 1) / n
    is_known = mine & np.isfinite(without)
    middle = without[is_known].mean() if is_known.any() else 0.0
    residuals = np.where(is_known, scale * (middle - without), 0.0)
    return Effects(residuals, weights, sign, _t(n - 1, 0.95))


def _value_of(kind: Kind, total: NDArray[np.float64], rows: NDArray[np.float64]) -> float:
    return float(_value(kind, np.array(total.sum()), np.array(rows.sum())))


def pooled(
    kind: Kind, total: NDArray[np.float64], rows: NDArray[np.float64]
) -> tuple[float, float]:
    """Return a metric pooled over places, and half its 95 % jackknife interval.

    Args:
        kind: Kind of the metric.
        total: Sum by place, shape (G,).
        rows: Number of rows by place, shape (G,); 0 for places without the metric.
    """
    mine = rows > 0.0
    total, rows, n = total[mine], rows[mine], int(mine.sum())
    value = _value_of(kind, total, rows)
    if n < MIN_CLUSTERS:
        return (value if n else math.nan), math.nan
    without = _value(kind, total.sum() - total, rows.sum() - rows)
    if kind == "sum":
        without = without * n / (n - 1)
    sd = math.sqrt((n - 1) / n * float(((without - without.mean()) ** 2).sum()))
    return value, _t(n - 1, 0.95) * sd


def _t(freedom: float, confidence: float) -> float:
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.5 + 0.5 * confidence))


class Effects(NamedTuple):
    """Effects of G places on the difference of one metric.

    Attributes:
        residuals: Shape (G,): influence on the difference, without the difference itself.
        weights: Shape (G,): part of a common difference that is the place's; sums up to 1.
        sign: 1 or -1, the direction in which a difference is sought.
        half: Half the interval of the difference, in its standard deviations.
    """

    residuals: Floats
    weights: Floats
    sign: float
    half: float


def detectable(effects: Mapping[str, Effects], swaps: Floats) -> dict[str, float]:
    """Return the difference of each metric that is found in ``POWER`` of the repetitions.

    Args:
        effects: Effects of the same places on each metric.
        swaps: Shape (S, G), as in ``paired``: 1 if a place's results are swapped.

    Returns:
        Infinite where no difference is found so often.
    """
    if not effects:
        return {}
    rng = np.random.default_rng(SEED)
    # Drawn, because all swaps in order begin with those of the first places only.
    signs = 1.0 - 2.0 * swaps[np.append(0, 1 + rng.permutation(len(swaps) - 1)[: TRIED - 1])]
    places = signs.shape[1]
    normal = rng.normal(0.0, 1.0, (REPETITIONS, places, places))
    scales = np.sqrt((places - 1.0) / rng.chisquare(places - 1, REPETITIONS))
    normal *= scales[:, None, None]
    # The largest and the second largest statistic of the unchanged metrics, under each swap.
    first = second = np.zeros((len(signs), REPETITIONS))
    leader = np.full(first.shape, -1)
    for number, one in enumerate(effects.values()):
        swapped = np.abs(signs @ _repeated(one, normal).T)
        scaled = swapped / np.maximum(_rms(swapped), ROUNDING)
        is_first = scaled > first
        second = np.where(is_first, first, np.maximum(second, scaled))
        leader = np.where(is_first, number, leader)
        first = np.where(is_first, scaled, first)
    return {
        path: _smallest(one, normal, signs, np.where(leader == number, second, first))
        for number, (path, one) in enumerate(effects.items())
    }


def _repeated(one: Effects, normal: Floats) -> Floats:
    """Return effects of other places on the difference, shape (repetitions, G)."""
    mine = one.weights > 0.0
    return np.asarray(normal @ one.residuals / math.sqrt(mine.sum() - 1) * mine)


def _rms(swapped: Floats) -> Floats:
    return np.asarray(np.sqrt((swapped**2).mean(axis=0)))


def _smallest(one: Effects, normal: Floats, signs: Floats, others: Floats) -> float:
    residuals, n = _repeated(one, normal), np.count_nonzero(one.weights)
    by_chance, by_change = signs @ residuals.T, one.sign * (signs @ one.weights)[:, None]
    chance = residuals.sum(axis=1)
    off = residuals - chance[:, None] * one.weights
    half = one.half * np.sqrt(n / (n - 1) * (off**2).sum(axis=1))

    def power(difference: float) -> float:
        swapped = np.abs(by_chance + difference * by_change)
        found = one.sign * chance + difference
        scaled = swapped / np.maximum(_rms(swapped), ROUNDING)
        p = (np.maximum(scaled, others) >= scaled[0] - ROUNDING).mean(axis=0)
        return float(((p <= FALSE_ALARMS) & (found > half)).mean())

    high = float(np.abs(chance).mean()) or ROUNDING
    for _ in range(DOUBLINGS):
        if power(high) >= POWER:
            break
        high *= 2.0
    else:
        return math.inf
    low = 0.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if power(middle) >= POWER else (middle, high)
    return high
