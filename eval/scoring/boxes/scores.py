"""Average precision, precision and recall of detections, with intervals over pictures.

Average precision is COCO's: the mean of the precision's upper envelope at 101 recalls, over the
overlaps 0.5 to 0.95 (AP) or at 0.5 (AP50). Pictures that are close in time show the same objects,
so blocks of pictures are the independent units. The standard deviation of AP is estimated by the
bootstrap over blocks (Davison and Hinkley, *Bootstrap Methods*, 1997), and those of precision and
recall by the jackknife. Intervals are those of ``crosscue.eval.scoring.intervals``, because
bootstrap percentiles are too narrow for few blocks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from crosscue.eval.scoring.intervals import (
    MIN_CLUSTERS,
    UNKNOWN,
    Interval,
    Spread,
    fraction_by_cluster,
)
from crosscue.replay.columns import Floats, Int64s

from .matching import ALL, OVERLAPS, RANGES, SIZES, BoxSelection, LabelledBoxes, Matched, match

RECALLS: Final = np.linspace(0.0, 1.0, 101)
ROUNDS: Final = 1000
SEED: Final = 0


@dataclass(frozen=True, slots=True)
class IntervalEstimate:
    """A number with its 95 % interval; NaN if undefined."""

    value: float
    low: float
    high: float


_UNKNOWN: Final = IntervalEstimate(math.nan, math.nan, math.nan)


@dataclass(frozen=True, slots=True)
class PartScore:
    """Scores of one class in one part.

    Attributes:
        label: The class; ``all`` for the mean over classes.
        part: Size or range; ``all`` for all boxes.
        labels: Number of labels to detect.
        right: Number of correct detections above the threshold, at the requested overlap.
        wrong: Number of false detections above the threshold; of a class without any label, the
            number of detections that cannot be judged.
        threshold: Threshold for ``right`` and ``wrong``.
        ap: Average precision over overlaps 0.5 to 0.95.
        ap50: Average precision at overlap 0.5.
        precision: Precision above the threshold.
        recall: Recall above the threshold.
    """

    label: str
    part: str
    labels: int
    right: int
    wrong: int
    threshold: float
    ap: IntervalEstimate
    ap50: IntervalEstimate
    precision: IntervalEstimate
    recall: IntervalEstimate


def score_parts(
    truth: LabelledBoxes,
    found: LabelledBoxes,
    classes: Sequence[str],
    thresholds: Mapping[str, float],
    blocks: Int64s,
    overlap: float = 0.5,
    seed: int = SEED,
) -> list[PartScore]:
    """Score every class in every non-empty part, and the mean over classes.

    Args:
        truth: Labels.
        found: Detections.
        classes: Names of the classes, by their number in both.
        thresholds: Threshold by class.
        blocks: Shape (P,): block of each picture; blocks are resampled as a unit.
        overlap: Min overlap of a correct detection, for precision and recall.
        seed: Seed of the bootstrap.
    """
    weights = drawn(blocks, seed)
    has_range = bool((np.isfinite(truth.range_m) & ~truth.is_ignored).any())
    scores: list[PartScore] = []
    labelled: set[str] = set()
    for part in (ALL, *SIZES, *(RANGES if has_range else ())):
        rows = [
            _Row.of(match(truth, found, k, part, np.append(OVERLAPS, overlap)), blocks, weights)
            for k in range(len(classes))
        ]
        some = [
            row.scored(name, part, thresholds[name])
            for name, row in zip(classes, rows, strict=True)
        ]
        if part in RANGES and not np.isfinite(found.range_m).any():
            # False detections have no range, so they are in no part.
            some = [replace(one, precision=_UNKNOWN) for one in some]
        known = [row for row in rows if row.labels]
        if part is ALL:
            labelled = {one.label for one in some if one.labels}
            # No label shows whether these detections are right.
            some = [
                one if one.label in labelled else replace(one, precision=_UNKNOWN) for one in some
            ]
            if known:
                scores.append(_mean(known, [one for one in some if one.label in labelled]))
        scores += [
            one
            for one in some
            if one.labels or (one.wrong and (part is ALL or one.label in labelled))
        ]
    return scores


def drawn(blocks: Int64s, seed: int, rounds: int = ROUNDS) -> Floats | None:
    """Draw how often each picture is in a bootstrap sample, shape (R, P); None for few blocks.

    Args:
        blocks: Shape (P,): block of each picture.
        seed: Seed of the random numbers.
        rounds: Number R of bootstrap samples.
    """
    names, which = np.unique(blocks, return_inverse=True)
    n = len(names)
    if n < MIN_CLUSTERS:
        return None
    times = np.random.default_rng((seed, n)).multinomial(n, np.full(n, 1.0 / n), rounds)
    return np.asarray(times[:, which], np.float64)


def interval_of(value: float, rounds: Floats, blocks: int) -> Interval:
    """Return the 95 % interval of a number from 0 to 1, from its values in bootstrap samples."""
    kept = rounds[np.isfinite(rounds)]
    if blocks < MIN_CLUSTERS or not len(kept) or not math.isfinite(value):
        return UNKNOWN
    # Samples of few blocks vary less than new blocks would.
    sd = float(kept.std()) * math.sqrt(blocks / (blocks - 1))
    return Spread(value, sd, blocks, blocks).within_0_and_1(math.inf)


def average_precision(matched: Matched, step: int, weights: Floats | None = None) -> Floats:
    """Return the average precision at one overlap, for all pictures or for R samples of them.

    Args:
        matched: Matched detections of one class.
        step: Index of the overlap.
        weights: Shape (R, P): count of each picture in each sample; None counts each once.

    Returns:
        Shape (R,), or (1,) without ``weights``.
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
    """One class in one part, with the values of all bootstrap samples."""

    matched: Matched
    blocks: Int64s
    ap: Floats
    ap50: Floats
    ap_rounds: Floats
    ap50_rounds: Floats

    @classmethod
    def of(cls, matched: Matched, blocks: Int64s, weights: Floats | None) -> _Row:
        steps = range(len(OVERLAPS))
        each = np.stack([average_precision(matched, step) for step in steps])
        rounds = (
            np.full((len(OVERLAPS), 1), math.nan)
            if weights is None
            else np.stack([average_precision(matched, step, weights) for step in steps])
        )
        return cls(matched, blocks, each.mean(axis=0), each[0], rounds.mean(axis=0), rounds[0])

    @property
    def labels(self) -> int:
        return len(self.matched.labels)

    def scored(self, label: str, part: BoxSelection, threshold: float) -> PartScore:
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
            _measured(float(self.ap[0]), self.ap_rounds, self.blocks),
            _measured(float(self.ap50[0]), self.ap50_rounds, self.blocks),
            _fraction_of(right, wrong, self.blocks),
            _fraction_of(right, _less(self.matched.labels, right), self.blocks),
        )


def _mean(rows: Sequence[_Row], some: Sequence[PartScore]) -> PartScore:
    """Return the mean over classes with labels, as in COCO; counts are summed."""

    def over(name: str) -> IntervalEstimate:
        rounds = np.stack([getattr(row, f"{name}_rounds") for row in rows]).mean(axis=0)
        value = float(np.mean([getattr(row, name)[0] for row in rows]))
        return _measured(value, rounds, rows[0].blocks)

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


def _measured(value: float, rounds: Floats, blocks: Int64s) -> IntervalEstimate:
    return IntervalEstimate(value, *interval_of(value, rounds, len(np.unique(blocks))))


def _less(of: Int64s, right: Int64s) -> Int64s:
    """Return the pictures of missed labels: those of all labels minus those of found ones."""
    n = int(max(of.max(initial=-1), right.max(initial=-1))) + 1
    left = np.bincount(of, minlength=n) - np.bincount(right, minlength=n)
    return np.repeat(np.arange(n), np.maximum(left, 0))


def _fraction_of(right: Int64s, wrong: Int64s, blocks: Int64s) -> IntervalEstimate:
    """Return the fraction that is right, from the pictures of right and wrong items."""
    is_right = np.repeat([True, False], [len(right), len(wrong)])
    if not len(is_right):
        return _UNKNOWN
    ends = fraction_by_cluster(is_right, blocks[np.concatenate([right, wrong])])
    return IntervalEstimate(len(right) / len(is_right), *ends)
