"""Covariances of positions, and their 2-sigma ellipses."""

import numpy as np

from crosscue.replay.columns import Floats


def position_cov(xx: Floats, xy: Floats, yy: Floats) -> Floats:
    """Return the covariances of N positions, shape (N, 2, 2)."""
    return np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2)


def ellipses(centers: Floats, cov: Floats, points: int = 41) -> Floats:
    """Return the 2-sigma ellipses of N positions, shape (N, points, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, points)
    values, vectors = np.linalg.eigh(cov)
    axes = vectors * (2.0 * np.sqrt(np.maximum(values, 0.0)))[:, None, :]
    rings: Floats = np.swapaxes(axes @ np.stack([np.cos(angle), np.sin(angle)]), 1, 2)
    return rings + centers[:, None, :]
