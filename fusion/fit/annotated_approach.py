"""An approach of a run with the ground truth of its intersection."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.fusion.factor_graph import CueNode

# Count of a cue that was not evaluated.
NOT_EVALUATED: Final = -1

Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class AnnotatedApproach:
    """N frames of one approach, with the ground truth of its intersection.

    Attributes:
        way_m: Shape (N,): distance since the first frame, non-decreasing.
        time_s: Shape (N,): time since the first frame, non-decreasing.
        is_near: Shape (N,): True if the intersection was known to be near.
        is_established: Shape (N,): True if earlier frames had established presence.
        counts: Counts of each cue, shape (N,), or ``NOT_EVALUATED``.
        features: True or False for each known feature; a missing one is unknown.
        place: Name of the intersection; drives to the same one are not independent evidence.
    """

    way_m: NDArray[np.float64]
    time_s: NDArray[np.float64]
    is_near: Bools
    is_established: Bools
    counts: Mapping[str, NDArray[np.int64]]
    features: Mapping[str, bool]
    place: str

    def observed(self, cue: CueNode) -> NDArray[np.int64]:
        """Indices of frames in which the cue was evaluated and would send a message."""
        count = self.counts.get(cue.name)
        if count is None:
            return np.empty(0, np.int64)
        sends = (count != NOT_EVALUATED) & (self.is_established | cue.can_start)
        return np.flatnonzero(sends).astype(np.int64)
