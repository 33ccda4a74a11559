"""Fit the logistic regression of ``fusion.kind = "combined"`` to annotated drives.

Ridge regression (Hoerl, Kennard, *Technometrics* 12, 1970) on standardised statistics, by Newton's
method. Each drive has weight 1, whatever its number of frames. Ridge and fading distance were
chosen on layouts M0 to M51 of ``crosscue study layouts --perception faults``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.fusion.combined import EvidenceSums, mixed
from crosscue.fusion.factor_graph import FactorGraph
from crosscue.replay.vehicle.combined import Combined

from .temporal_fit import AnnotatedDrive, TemporalFit, filtered, frames_of

RIDGE: Final = 0.3
NEWTON_STEPS: Final = 30
FADE_M: Final = 50.0
# Statistics that vary less have no effect.
MIN_SD: Final = 1e-6


def fit_combined(
    drives: Sequence[AnnotatedDrive], graph: FactorGraph, temporal: TemporalFit
) -> Combined:
    """Fit the regression of each feature; the belief over time was fitted to the same drives."""
    step_m = temporal.temporal.step_m
    found = [statistics_of(one, graph, step_m) for one in drives]
    rows = np.vstack(found)
    middle, sd = rows.mean(axis=0), np.maximum(rows.std(axis=0), MIN_SD)
    intercepts: dict[str, float] = {}
    weights: dict[str, dict[str, float]] = {}
    for name in graph.feature_names:
        known = [i for i, one in enumerate(drives) if name in one.features]
        if not known:
            intercepts[name], weights[name] = 0.0, {}
            continue
        x = np.vstack([(found[i] - middle) / sd for i in known])
        counts = [len(found[i]) for i in known]
        truth = np.repeat([float(drives[i].features[name]) for i in known], counts)
        weight = np.repeat([1.0 / count for count in counts], counts)
        first, *others = ridge_logistic(x, truth, weight)
        scaled = np.array(others) / sd
        intercepts[name] = round(float(first - scaled @ middle), 6)
        pairs = zip(graph.feature_names, scaled.tolist(), strict=True)
        weights[name] = {other: round(value, 6) for other, value in pairs}
    return Combined(intercepts=intercepts, weights=weights, fade_m=FADE_M)


def ridge_logistic(
    x: NDArray[np.float64],
    truth: NDArray[np.float64],
    weight: NDArray[np.float64],
    ridge: float = RIDGE,
) -> NDArray[np.float64]:
    """Return the intercept, which is not shrunk, and the coefficients of a logistic regression.

    Args:
        x: Shape (N, K).
        truth: Shape (N,): 1 or 0.
        weight: Shape (N,).
        ridge: Weight of the coefficients' squares.
    """
    x = np.column_stack([np.ones(len(x)), x])
    # A little ridge on the intercept keeps it finite if all drives agree.
    penalty = np.r_[1e-3, np.full(x.shape[1] - 1, ridge)]
    found = np.zeros(x.shape[1])
    for _ in range(NEWTON_STEPS):
        p = 1.0 / (1.0 + np.exp(-np.clip(x @ found, -40.0, 40.0)))
        slope = x.T @ (weight * (p - truth)) + penalty * found
        curvature = (x * (weight * p * (1.0 - p))[:, None]).T @ x + np.diag(penalty)
        step = np.linalg.solve(curvature, slope)
        found -= step
        if float(np.abs(step).max()) < 1e-9:
            break
    return found


def statistics_of(
    drive: AnnotatedDrive, graph: FactorGraph, step_m: float, fade_m: float = FADE_M
) -> NDArray[np.float64]:
    """Return the statistics after each frame, shape (N, features)."""
    sums, out = EvidenceSums(graph, fade_m, step_m), []
    for counts, moved_m in zip(frames_of(drive), drive.advanced_m.tolist(), strict=True):
        sums.update(counts, moved_m)
        out.append(sums.statistics())
    return np.array(out).reshape(len(drive.start_m), len(graph.feature_names))


def combined_beliefs(
    drive: AnnotatedDrive, graph: FactorGraph, temporal: TemporalFit, combined: Combined
) -> NDArray[np.float64]:
    """Return the probabilities after each frame, shape (N, features)."""
    statistics = statistics_of(drive, graph, temporal.temporal.step_m, combined.fade_m)
    return mixed(filtered(drive, temporal.model), statistics, combined, graph)
