"""Fit the logistic regression of ``fusion.kind = "combined"`` to annotated drives.

Ridge regression (Hoerl, Kennard, *Technometrics* 12, 1970) on standardised statistics, by Newton's
method. Each drive has weight 1, whatever its number of frames. Ridge and fading distance were
chosen on layouts M0 to M155 of ``crosscue study layouts --perception faults``.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.fusion.combined import CombinedModel
from crosscue.fusion.factor_graph import FactorGraph
from crosscue.replay.vehicle.fusion import Combined

from .temporal_fit import AnnotatedDrive, TemporalFit, filtered, frames_of

RIDGE: Final = 0.3
NEWTON_STEPS: Final = 30
# Ridge of the intercept, which keeps it finite if all drives agree.
RIDGE_OF_INTERCEPT: Final = 1e-3
# Statistics that vary less have no effect.
MIN_SD: Final = 1e-6
NOTHING: Final = Combined(intercepts={}, positive={}, negative={})


def fit_combined(drives: Sequence[AnnotatedDrive], graph: FactorGraph) -> Combined:
    """Fit the regression of each feature."""
    empty = CombinedModel(graph, NOTHING)
    found = [statistics_of(one, empty) for one in drives]
    rows = np.vstack(found)
    middle, sd = rows.mean(axis=0), rows.std(axis=0)
    scale = np.where(sd > MIN_SD, 1.0 / np.maximum(sd, MIN_SD), 0.0)
    intercepts: dict[str, float] = {}
    positive: dict[str, dict[str, float]] = {}
    negative: dict[str, dict[str, float]] = {}
    for name in graph.feature_names:
        known = [i for i, one in enumerate(drives) if name in one.features and len(found[i])]
        if not known:
            continue
        counts = [len(found[i]) for i in known]
        first, *others = ridge_logistic(
            (np.vstack([found[i] for i in known]) - middle) * scale,
            np.repeat([float(drives[i].features[name]) for i in known], counts),
            np.repeat([1.0 / count for count in counts], counts),
        )
        weights = np.array(others) * scale
        intercepts[name] = float(first - weights @ middle)
        for side, column in ((positive, weights[0::2]), (negative, weights[1::2])):
            pairs = zip(empty.cues, column.tolist(), strict=True)
            side[name] = {cue: weight for cue, weight in pairs if weight}
    return Combined(intercepts=intercepts, positive=positive, negative=negative)


def ridge_logistic(
    x: NDArray[np.float64],
    truth: NDArray[np.float64],
    weight: NDArray[np.float64],
    ridge: float = RIDGE,
) -> NDArray[np.float64]:
    """Return the intercept, which is hardly shrunk, and the coefficients of a logistic regression.

    Args:
        x: Shape (N, K).
        truth: Shape (N,): 1 or 0.
        weight: Shape (N,).
        ridge: Weight of the coefficients' squares.
    """
    x = np.column_stack([np.ones(len(x)), x])
    penalty = np.append(RIDGE_OF_INTERCEPT, np.full(x.shape[1] - 1, ridge))
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


def statistics_of(drive: AnnotatedDrive, model: CombinedModel) -> NDArray[np.float64]:
    """Return the statistics after each frame, shape (N, 2 cues)."""
    running, out = model.counts(), []
    for counts, moved_m in zip(frames_of(drive), drive.advanced_m.tolist(), strict=True):
        running.update(counts, moved_m)
        out.append(running.statistics())
    return np.array(out).reshape(len(drive.start_m), 2 * len(model.cues))


def combined_beliefs(
    drive: AnnotatedDrive, graph: FactorGraph, temporal: TemporalFit, combined: Combined
) -> NDArray[np.float64]:
    """Return the probabilities after each frame, shape (N, features)."""
    model = CombinedModel(graph, combined)
    return model.mixed(filtered(drive, temporal.model), statistics_of(drive, model))
