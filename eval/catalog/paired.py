"""Paired comparison of two runs' metrics over drives: better, worse or undecided.

If both runs are equally good, it is arbitrary which of a drive's two results came from which run.
Swapping them at random, drive by drive, shows how far metrics differ by chance (a permutation test;
Good, *Permutation, Parametric and Bootstrap Tests of Hypotheses*, chapter 3).

Many cues under many conditions are many chances for a false alarm. They are corrected by Holm's
procedure (*Scandinavian Journal of Statistics* 6, 1979) with the joint distribution of the swaps in
place of Bonferroni's bound (Westfall, Young, *Resampling-Based Multiple Testing*, 1993, algorithm
4.1): starting with the metric that differs most in units of its own spread, each is judged by the
largest difference over the remaining ones. A metric that did not change is therefore called better
or worse in at most 5 % of comparisons, for any number of metrics, any dependence between them, and
any change of the others. Benjamini and Hochberg's procedure decides more, but allows 5 % of its
verdicts to be false, which is too many for a gate that fails on a single one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.scoring.by_drive import Direction, DriveMetric, Kind, direction
from crosscue.eval.scoring.intervals import MIN_CLUSTERS

# Max fraction of comparisons in which any unchanged metric gets a verdict.
FALSE_ALARMS: Final = 0.05
# With five drives, no p value is below 2 / 32, so nothing would ever be decided.
MIN_DRIVES: Final = 6
# Standard normal quantile of the power: the detectable difference is found with about 80 %.
POWER_QUANTILE: Final = 0.841621
# Above this, the number of drives that would decide is not printed.
MAX_DRIVES: Final = 1_000_000
EXACT_DRIVES: Final = 12
SWAPS: Final = 1 << EXACT_DRIVES
SEED: Final = 0
ROUNDING: Final = 1e-9

Verdict = Literal["better", "worse", "undecided"]


@dataclass(frozen=True, slots=True)
class PairedMetric:
    """One metric over the drives that both runs have.

    Attributes:
        path: Path of the metric, as in gates.
        before: Value in the first run.
        after: Value in the second run.
        better: Good direction of the metric.
        drives: Number of drives with rows in at least one run.
        low: Lower end of the 95 % interval of after minus before, over drives; NaN below four
            drives.
        high: Upper end of the interval.
        p: p value, corrected for all metrics.
        could_see: The smallest difference that 80 % of comparisons would detect; infinite below
            six drives.
        more_drives: Number of additional drives, as varied as these, with which 80 % of
            comparisons would detect a difference of this size; 0 if it is decided or zero, None if
            unknown.
        allowed: Allowed loss.
        verdict: Verdict on the second run.
    """

    path: str
    before: float
    after: float
    better: Direction
    drives: int
    low: float
    high: float
    p: float
    could_see: float
    more_drives: int | None
    allowed: float
    verdict: Verdict


class _Sums(NamedTuple):
    """Totals and numbers of rows by drive in the first and in the second run, shapes (G,)."""

    total: NDArray[np.float64]
    rows: NDArray[np.float64]
    other_total: NDArray[np.float64]
    other_rows: NDArray[np.float64]


def compare_drives(
    first: Sequence[DriveMetric],
    second: Sequence[DriveMetric],
    allowed_of: Callable[[str, float], float] = lambda path, before: 0.0,
) -> tuple[PairedMetric, ...]:
    """Compare every judged metric that both runs have, over the drives that both have.

    Args:
        first: Contributions of drives to the metrics of the reference run.
        second: The same for the run to judge.
        allowed_of: Function from the path and the value before to the allowed loss.
    """
    logs = sorted({one.log for one in first} & {one.log for one in second})
    kinds: dict[str, Kind] = {one.metric: one.kind for one in (*first, *second)}
    known = {one.metric for one in first} & {one.metric for one in second}
    paths = [path for path in kinds if path in known and direction(path) is not None]
    found = _sums(logs, first, second)
    sums = {path: found[path] for path in paths if path in found}
    sums = {path: one for path, one in sums.items() if one.rows.any() and one.other_rows.any()}
    swaps = _swaps(len(logs))
    spread = {path: _swapped(kinds[path], one, swaps) for path, one in sums.items()}
    units = {path: float(np.sqrt(np.mean(one**2))) for path, one in spread.items()}
    differing = [path for path in sums if units[path] > 0.0]
    scaled = np.array([np.abs(spread[path]) / units[path] for path in differing])
    p, critical = step_down(scaled.reshape(len(differing), len(swaps)))
    p_of = dict(zip(differing, map(float, p), strict=True))
    return tuple(
        _judged(path, kinds[path], sums[path], p_of.get(path, 1.0), critical, allowed_of)
        for path in sums
    )


def step_down(
    statistics: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """Return corrected p values and the critical value over all metrics.

    Args:
        statistics: Shape (M, S), of M metrics under S swaps, each in units of its own spread. The
            first column is the observation.

    Returns:
        The p values, shape (M,), and the critical value; infinite if there are too few swaps for
        any verdict.
    """
    metrics = len(statistics)
    if not metrics:
        return np.ones(0), math.inf
    order = np.argsort(-statistics[:, 0], kind="stable")
    ordered = statistics[order]
    # Maximum over each metric and all metrics that differ less.
    largest = np.maximum.accumulate(ordered[::-1], axis=0)[::-1]
    corrected = np.empty(metrics)
    is_reached = largest >= ordered[:, :1] - ROUNDING
    corrected[order] = np.maximum.accumulate(is_reached.mean(axis=1))
    return corrected, _critical(largest[0])


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


def _swaps(drives: int) -> NDArray[np.float64]:
    """Return swaps, shape (S, G): 1 if a drive's results are swapped; the first row swaps none."""
    if drives <= EXACT_DRIVES:
        rows = np.arange(1 << drives)[:, None]
        return (rows >> np.arange(drives) & 1).astype(np.float64)
    drawn = np.random.default_rng(SEED).integers(0, 2, (SWAPS, drives)).astype(np.float64)
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


def _critical(largest: NDArray[np.float64]) -> float:
    """Return the critical value of the largest difference; infinite if there are too few swaps."""
    ordered = np.sort(largest)[::-1]
    rank = math.floor(FALSE_ALARMS * len(ordered) + ROUNDING)
    if rank < 1 or len(ordered) < 1 << MIN_DRIVES:
        return math.inf
    return float(ordered[rank - 1])


def _judged(
    path: str,
    kind: Kind,
    sums: _Sums,
    p: float,
    critical: float,
    allowed_of: Callable[[str, float], float],
) -> PairedMetric:
    better = direction(path)
    assert better is not None
    before, after = (
        float(_value(kind, np.array(total.sum()), np.array(rows.sum())))
        for total, rows in ((sums.total, sums.rows), (sums.other_total, sums.other_rows))
    )
    difference = after - before
    sd, drives = _jackknife(kind, sums)
    half = _t(drives - 1, 0.95) * sd if drives >= MIN_CLUSTERS else math.nan
    allowed = allowed_of(path, before)
    sign = 1.0 if better == "higher" else -1.0
    verdict: Verdict = "undecided"
    if p <= FALSE_ALARMS and drives >= MIN_DRIVES and half < abs(difference):
        if sign * difference > 0.0:
            verdict = "better"
        elif abs(difference) - half > allowed:
            verdict = "worse"
    could_see = (critical + POWER_QUANTILE) * sd if sd else math.nan
    could_see = could_see if drives >= MIN_DRIVES else math.inf
    is_open = verdict == "undecided" and difference != 0.0
    return PairedMetric(
        path=path,
        before=before,
        after=after,
        better=better,
        drives=drives,
        low=difference - half,
        high=difference + half,
        p=p,
        could_see=could_see,
        more_drives=_more_drives(could_see, difference, drives) if is_open else 0,
        allowed=allowed,
        verdict=verdict,
    )


def _more_drives(could_see: float, difference: float, drives: int) -> int | None:
    """Return the additional drives needed; the detectable difference falls as 1 / sqrt(drives)."""
    if not math.isfinite(could_see):
        return None
    enough = drives * (could_see / difference) ** 2
    return max(math.ceil(enough) - drives, 1) if enough < MAX_DRIVES else None


def _jackknife(kind: Kind, sums: _Sums) -> tuple[float, int]:
    """Return the jackknife standard deviation of the difference, and the number of drives used."""
    mine = (sums.rows > 0.0) | (sums.other_rows > 0.0)
    some = _Sums(*(column[mine] for column in sums))
    n = int(mine.sum())
    if n < 2:
        return math.nan, n
    differences = _value(
        kind, some.other_total.sum() - some.other_total, some.other_rows.sum() - some.other_rows
    ) - _value(kind, some.total.sum() - some.total, some.rows.sum() - some.rows)
    if kind == "sum":
        differences = differences * n / (n - 1)
    known = differences[np.isfinite(differences)]
    return math.sqrt((n - 1) / n * float(((known - known.mean()) ** 2).sum())), n


def pooled(
    kind: Kind, total: NDArray[np.float64], rows: NDArray[np.float64]
) -> tuple[float, float, int]:
    """Return a metric pooled over drives, half its 95 % jackknife interval, and the drives used.

    Args:
        kind: Kind of the metric.
        total: Sum by drive, shape (G,).
        rows: Number of rows by drive, shape (G,); 0 for drives without the metric.
    """
    mine = rows > 0.0
    total, rows, n = total[mine], rows[mine], int(mine.sum())
    value = float(_value(kind, np.array(total.sum()), np.array(rows.sum())))
    if n < MIN_CLUSTERS:
        return (value if n else math.nan), math.nan, n
    without = _value(kind, total.sum() - total, rows.sum() - rows)
    if kind == "sum":
        without = without * n / (n - 1)
    sd = math.sqrt((n - 1) / n * float(((without - without.mean()) ** 2).sum()))
    return value, _t(n - 1, 0.95) * sd, n


def _t(freedom: int, confidence: float) -> float:
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.5 + 0.5 * confidence))
