"""NEES of a simulated drive's filter for errors along an arc."""

import math

import numpy as np
from numpy.typing import NDArray

from crosscue.localization.angles import wrap


def nees_along_the_arc(row: NDArray[np.float64]) -> float:
    """Return the NEES of the rigid motion from the estimate to the truth.

    It is consistent for errors along an arc (Long, Wolfe, Mashner, Chirikjian, *The banana
    distribution is Gaussian*, RSS 2012).

    Args:
        row: Shape (16,): one row of ``Traced.steps``.
    """
    x, y, heading = row[:3]
    at_x, at_y, at_heading = row[7:10]
    xx, xy, xh, yy, yh, hh = row[10:16]
    cov = np.array([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]])
    turn = wrap(heading - at_heading)
    half = 0.5 * turn
    along = half / math.tan(half) if half else 1.0
    dx, dy = x - at_x, y - at_y
    # In the frame of the estimate, the motion has the covariance of the pose.
    error = np.array([along * dx + half * dy, along * dy - half * dx, turn])
    return float(error @ np.linalg.solve(cov, error))
