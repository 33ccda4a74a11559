"""Fit calibrations to judged detections."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.catalog.class_scores import Isotonic, Platt


def fit_platt(scores: NDArray[np.float64], is_right: NDArray[np.bool_]) -> Platt:
    """Logistic regression on the score's logit (Platt 1999).

    Args:
        scores: Shape (N,), in [0, 1].
        is_right: Shape (N,); both values occur.
    """
    from scipy.optimize import minimize

    kept = np.clip(scores, 1e-6, 1.0 - 1e-6)
    logit = np.log(kept / (1.0 - kept))
    right = int(is_right.sum())
    # Platt's targets: one more correct and one more wrong detection than observed.
    target = np.where(is_right, (right + 1) / (right + 2), 1 / (len(is_right) - right + 2))

    def cost(at: NDArray[np.float64]) -> float:
        z = np.exp(at[0]) * logit + at[1]
        return float((np.logaddexp(0.0, z) - target * z).mean())

    best = minimize(cost, np.zeros(2), method="Nelder-Mead").x
    slope, offset = float(np.clip(np.exp(best[0]), 0.05, 20.0)), float(np.clip(best[1], -20, 20))
    return Platt(kind="platt", slope=round(slope, 5), offset=round(offset, 5))


def fit_isotonic(scores: NDArray[np.float64], is_right: NDArray[np.bool_]) -> Isotonic:
    """Isotonic regression, with its steps joined at their centres.

    Args:
        scores: Shape (N,), in [0, 1].
        is_right: Shape (N,).
    """
    from scipy.optimize import isotonic_regression

    order = np.argsort(scores, kind="stable")
    level = np.asarray(isotonic_regression(is_right[order].astype(np.float64)).x, np.float64)
    starts = np.flatnonzero(np.diff(level, prepend=-1.0) > 1e-12)
    steps = [part.mean() for part in np.split(scores[order], starts[1:])]
    middles, which = np.unique(np.round(steps, 6), return_index=True)
    fractions = np.round(level[starts][which], 6)
    return Isotonic(
        kind="isotonic", scores=tuple(middles.tolist()), fractions=tuple(fractions.tolist())
    )
