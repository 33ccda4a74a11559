"""Columns of a run's tables that are scored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Floats, Int64s

# Reason why rows around a set-back of the clock are not scored.
AMBIGUOUS: Final = "log time comes twice"
# Value for rows without an approach.
NONE: Final = -1


@dataclass(frozen=True, slots=True, eq=False)
class CueRows:
    """N rows of cues: what was searched in a frame, and the number found.

    Attributes:
        t_ns: Shape (N,).
        approach: Shape (N,); ``NONE`` outside approaches.
        cue: Shape (N,), names of cues.
        count: Shape (N,), not negative.
    """

    t_ns: Int64s
    approach: Int64s
    cue: NDArray[np.str_]
    count: Int64s


@dataclass(frozen=True, slots=True, eq=False)
class RangeRows:
    """N rows of the range filter; ``reference`` is ``start`` or ``end``."""

    t_ns: Int64s
    approach: Int64s
    reference: NDArray[np.str_]
    range_m: Floats
    var_m2: Floats


@dataclass(frozen=True, slots=True, eq=False)
class BeliefRows:
    """N steps of the belief.

    Attributes:
        t_ns: Shape (N,).
        approach: Shape (N,); ``NONE`` outside approaches.
        features: N probabilities by name of the feature, NaN where missing.
        established: Shape (N,): True where the presence of the intersection is established.
    """

    t_ns: Int64s
    approach: Int64s
    features: Mapping[str, Floats]
    established: NDArray[np.bool_]

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> BeliefRows:
        """Return some of the steps."""
        features = {name: values[rows] for name, values in self.features.items()}
        return BeliefRows(self.t_ns[rows], self.approach[rows], features, self.established[rows])


@dataclass(frozen=True, slots=True, eq=False)
class RunTables:
    """The tables of a run that are scored; None for a missing table.

    Attributes:
        frames_ns: Sorted times of all examined frames.
        cues: From ``cues.parquet``.
        ranges: From ``range.parquet``.
        belief: From ``belief.parquet``.
        ambiguous: Numbers of rows left out because their log time occurs twice: of ``frames``, of
            ``belief``, and of ranges by reference (``start``, ``end``).
    """

    frames_ns: Int64s | None
    cues: CueRows | None
    ranges: RangeRows | None
    belief: BeliefRows | None
    ambiguous: Mapping[str, int] = field(default_factory=dict)

    def span_ns(self) -> tuple[int, int] | None:
        """First and last time in any table; None if all are empty."""
        tables = (self.cues, self.ranges, self.belief)
        times = [part.t_ns for part in tables if part is not None]
        if self.frames_ns is not None:
            times.append(self.frames_ns)
        times = [t_ns for t_ns in times if len(t_ns)]
        if not times:
            return None
        return min(int(t.min()) for t in times), max(int(t.max()) for t in times)
