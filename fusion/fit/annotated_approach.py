"""An approach of a run beside what is true of its intersection."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.fusion.factor_graph import CueNode

NOT_LOOKED: Final = -1
"""Count of a cue that nothing looked for."""

Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class AnnotatedApproach:
    """N frames of one approach and what is true of its intersection.

    Attributes:
        way_m: Shape (N,), gone since its first frame, never falling.
        time_s: Shape (N,), likewise.
        is_near: Shape (N,): the intersection was known to be near.
        is_established: Shape (N,): its presence was, by earlier frames.
        counts: From cue to shape (N,): how many, or ``NOT_LOOKED``.
        features: Which are there, and which are not; one not named is not known.
        place: Which intersection; drives up to the same one are not new evidence about others.
    """

    way_m: NDArray[np.float64]
    time_s: NDArray[np.float64]
    is_near: Bools
    is_established: Bools
    counts: Mapping[str, NDArray[np.int64]]
    features: Mapping[str, bool]
    place: str

    def looks(self, cue: CueNode) -> NDArray[np.int64]:
        """Frames in which the cue was looked for and would speak."""
        count = self.counts.get(cue.name)
        if count is None:
            return np.empty(0, np.int64)
        speaks = (count != NOT_LOOKED) & (self.is_established | cue.speaks_first)
        return np.flatnonzero(speaks).astype(np.int64)
