"""Average precision, precision and recall of detections, with intervals over pictures.

Average precision is COCO's: the mean of the precision's upper envelope at 101 recalls, over the
overlaps 0.5 to 0.95 (AP) or at 0.5 (AP50). Intervals are bootstraps: pictures are drawn again with
replacement (Davison and Hinkley, *Bootstrap Methods*, 1997), those that were taken close in time
together, since they show the same objects.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.scoring.intervals import MIN_CLUSTERS, UNKNOWN, Interval

from .matching import ALL, OVERLAPS, RANGES, SIZES, Boxes, Matched, Part, match

RECALLS: Final = np.linspace(0.0, 1.0, 101)
ROUNDS: Final = 1000
SEED: Final = 0
TAIL_PERCENT: Final = 2.5


@dataclass(frozen=True, slots=True)
class Measured:
    """A number with its 95 % interval; NaN where it is not defined."""

    value: float
    low: float
    high: float


_UNKNOWN: Final = Measured(math.nan, math.nan, math.nan)


@dataclass(frozen=True, slots=True)
class PartScore:
    """One class in one part.

    Attributes:
        label: The class; ``all`` for the mean over classes.
        part: Size or range; ``all`` for everything.
        labels: To be found.
        right: Detections above the threshold on a label, at the overlap asked for.
        wrong: Detections above the threshold on none.
        threshold: Only detections with a higher score count in these two.
        ap: Mean over overlaps 0.5 to 0.95.
        ap50: At 0.5.
        precision: Right of right and wrong.
        recall: Right of labels.
    """

    label: str
    part: str
    labels: int
    right: int
    wrong: int
    threshold: float
    ap: Measured
    ap50: Measured
    precision: Measured
    recall: Measured


def score_parts(
    truth: Boxes,
    found: Boxes,
    classes: Sequence[str],
    thresholds: Mapping[str, float],
    blocks: NDArray[np.int64],
    overlap: float = 0.5,
    seed: int = SEED,
) -> list[PartScore]:
    """Every class in every part that has something in it, and their mean.

    Args:
        truth: Labels.
        found: Detections.
        classes: By the numbers in both.
        thresholds: Of each class.
        blocks: Shape (P,): pictures of one block are drawn together.
        overlap: That makes a detection right, for precision and recall.
        seed: Of the bootstrap.
    """
    weights = drawn(blocks, seed)
    has_range = bool((np.isfinite(truth.range_m) & ~truth.is_ignored).any())
    scores = []
    for part in (ALL, *SIZES, *(RANGES if has_range else ())):
        rows = [
            _Row.of(match(truth, found, k, part, np.append(OVERLAPS, overlap)), weights)
            for k in range(len(classes))
        ]
        some = [
            row.scored(name, part, thresholds[name])
            for name, row in zip(classes, rows, strict=True)
        ]
        if part in RANGES and not np.isfinite(found.range_m).any():
            # Without a range of its own a false detection belongs nowhere.
            some = [replace(one, precision=_UNKNOWN) for one in some]
        known = [row for row in rows if row.labels]
        if known and part is ALL:
            scores.append(_mean(known, some))
        scores += [one for one in some if one.labels or one.wrong]
    return scores


def drawn(blocks: NDArray[np.int64], seed: int, rounds: int = ROUNDS) -> NDArray[np.float64] | None:
    """How often each picture is drawn, shape (R, P); None for fewer blocks than make an interval.

    Args:
        blocks: Shape (P,).
        seed: The same draws the same.
        rounds: How often.
    """
    names, which = np.unique(blocks, return_inverse=True)
    n = len(names)
    if n < MIN_CLUSTERS:
        return None
    times = np.random.default_rng((seed, n)).multinomial(n, np.full(n, 1.0 / n), rounds)
    return np.asarray(times[:, which], np.float64)


def interval_of(values: NDArray[np.float64]) -> Interval:
    """Where 95 % of the finite ones are."""
    kept = values[np.isfinite(values)]
    if not len(kept):
        return UNKNOWN
    low, high = np.percentile(kept, [TAIL_PERCENT, 100.0 - TAIL_PERCENT])
    return Interval(float(low), float(high))


def average_precision(
    matched: Matched, step: int, weights: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """At one overlap: as it is, or for each of R rounds of pictures drawn, shape (R,).

    Args:
        matched: Of one class.
        step: Number of the overlap.
        weights: Shape (R, P): how often each picture counts.
    """
    counted = weights if weights is not None else np.ones((1, _pictures(matched)))
    total = counted[:, matched.labels].sum(axis=1)
    keep = ~matched.is_out[step]
    each = counted[:, matched.picture[keep]]
    right = np.cumsum(each * matched.is_right[step][keep], axis=1)
    wrong = np.cumsum(each * matched.is_wrong[step][keep], axis=1)
    precision = right / (right + wrong + np.spacing(1))
    envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
    found = np.full(len(counted), math.nan)
    for i in np.flatnonzero(total > 0.0).tolist():
        at = np.searchsorted(right[i] / total[i], RECALLS, side="left")
        reached = at < envelope.shape[1]
        found[i] = envelope[i, at[reached]].sum() / len(RECALLS)
    return found


def _pictures(matched: Matched) -> int:
    return int(max(matched.picture.max(initial=-1), matched.labels.max(initial=-1))) + 1


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """One class in one part, with the values of every round of the bootstrap."""

    matched: Matched
    weights: NDArray[np.float64] | None
    ap: NDArray[np.float64]
    ap50: NDArray[np.float64]
    ap_rounds: NDArray[np.float64]
    ap50_rounds: NDArray[np.float64]

    @classmethod
    def of(cls, matched: Matched, weights: NDArray[np.float64] | None) -> _Row:
        steps = range(len(OVERLAPS))
        each = np.stack([average_precision(matched, step) for step in steps])
        rounds = (
            np.full((len(OVERLAPS), 1), math.nan)
            if weights is None
            else np.stack([average_precision(matched, step, weights) for step in steps])
        )
        return cls(matched, weights, each.mean(axis=0), each[0], rounds.mean(axis=0), rounds[0])

    @property
    def labels(self) -> int:
        return len(self.matched.labels)

    def scored(self, label: str, part: Part, threshold: float) -> PartScore:
        sure = self.matched.scores > threshold
        right = self.matched.picture[self.matched.is_right[-1] & sure]
        wrong = self.matched.picture[self.matched.is_wrong[-1] & sure]
        return PartScore(
            label,
            part.name,
            self.labels,
            len(right),
            len(wrong),
            threshold,
            _measured(float(self.ap[0]), self.ap_rounds),
            _measured(float(self.ap50[0]), self.ap50_rounds),
            _fraction_of(right, np.concatenate([right, wrong]), self.weights),
            _fraction_of(right, self.matched.labels, self.weights),
        )


def _mean(rows: Sequence[_Row], some: Sequence[PartScore]) -> PartScore:
    """Of classes with labels, as COCO has it; counts are sums."""

    def over(name: str) -> Measured:
        rounds = np.stack([getattr(row, f"{name}_rounds") for row in rows]).mean(axis=0)
        return _measured(float(np.mean([getattr(row, name)[0] for row in rows])), rounds)

    return PartScore(
        "all",
        ALL.name,
        sum(one.labels for one in some),
        sum(one.right for one in some),
        sum(one.wrong for one in some),
        math.nan,
        over("ap"),
        over("ap50"),
        _UNKNOWN,
        _UNKNOWN,
    )


def _measured(value: float, rounds: NDArray[np.float64]) -> Measured:
    return Measured(value, *interval_of(rounds))


def _fraction_of(
    right: NDArray[np.int64], of: NDArray[np.int64], weights: NDArray[np.float64] | None
) -> Measured:
    """Pictures of what is right, of those of everything."""
    value = len(right) / len(of) if len(of) else math.nan
    if weights is None or not len(of):
        return Measured(value, math.nan, math.nan)
    total = weights[:, of].sum(axis=1)
    rounds = weights[:, right].sum(axis=1) / np.where(total > 0.0, total, math.nan)
    return _measured(value, rounds)
