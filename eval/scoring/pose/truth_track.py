"""The true track that a recording shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class TruthTrack:
    """The true track on the log clock, in the map frame.

    Attributes:
        t_ns: Shape (N,), int64.
        x_m: Shape (N,).
        y_m: Shape (N,).
    """

    t_ns: NDArray[np.int64]
    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
