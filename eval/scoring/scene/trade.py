"""Full detection against false features, over all thresholds.

A belief that crosses a threshold earlier detects more intersections in full, and more features that
are absent. Beliefs are therefore compared at the same rate of false features, each with the lowest
threshold that keeps to the rate.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from crosscue.eval.scoring.intervals import Mean, fraction
from crosscue.replay.columns import Floats, Int64s

from .detection import CONFIRM_FRAMES, Flags

# Absent features per drive or approach.
RATES: Final = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)
ROUNDING: Final = 1e-9
# Feature that established presence counts as.
SURE: Final = "intersection"


class Reached(NamedTuple):
    """Thresholds below which a belief detects.

    Attributes:
        full: Threshold below which it fully detects the intersection; None without one, -1 for
            never.
        false: Greatest probability of each absent feature.
    """

    full: float | None
    false: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class TradePoint:
    """Full detection at one rate of false features.

    Attributes:
        wanted: Max number of false features per drive or approach.
        threshold: Lowest threshold with at most as many.
        false_features: Number at this threshold.
        full: Fraction of intersections with full detection above it, with its interval over
            places.
    """

    wanted: float
    threshold: float
    false_features: float
    full: Mean


def reached(
    features: Mapping[str, Floats], present: Collection[str], absent: Collection[str], sure: Flags
) -> Reached:
    """Return the thresholds that one drive or approach reaches.

    Args:
        features: Probabilities by feature, shape (N,) each.
        present: Features that are present; none without an intersection.
        absent: Features that are absent.
        sure: Shape (N,): True where presence is established. The intersection, present or absent,
            then counts with the greatest probability so far, which established it.
    """
    counted = dict(features)
    if SURE in features:
        # What established it once, at any lower threshold, is the greatest probability so far.
        so_far = np.maximum.accumulate(np.max(np.stack([*features.values()]), axis=0))
        counted[SURE] = np.where(sure, so_far, features[SURE])
    rows = [counted.get(name, np.empty(0)) for name in absent]
    false = tuple(float(one.max()) if len(one) else 0.0 for one in rows)
    if not present:
        return Reached(None, false)
    never = np.full(len(sure), -1.0)
    lowest = np.ones(len(sure))
    for name in present:
        lowest = np.minimum(lowest, counted.get(name, never))
    if len(lowest) < CONFIRM_FRAMES:
        return Reached(-1.0, false)
    windows = np.lib.stride_tricks.sliding_window_view(lowest, CONFIRM_FRAMES)
    return Reached(float(windows.min(axis=1).max()), false)


def trade_off(
    some: Sequence[Reached], places: Int64s, rates: Sequence[float] = RATES
) -> tuple[TradePoint, ...]:
    """Return full detection at each rate of false features per element of ``some``."""
    false = np.sort(np.array([p for one in some for p in one.false]))[::-1]
    full = np.array([math.nan if one.full is None else one.full for one in some])
    has = np.isfinite(full)
    points = []
    for rate in rates:
        allowed = math.floor(rate * len(some) + ROUNDING)
        threshold = float(false[allowed]) if allowed < len(false) else 0.0
        found = fraction(full[has] > threshold, places[has])
        ends = Mean(found.value, found.clusters_low, found.clusters_high, found.of, found.clusters)
        rate_found = float((false > threshold).sum()) / max(len(some), 1)
        points.append(TradePoint(rate, threshold, rate_found, ends))
    return tuple(points)
