"""The part of a run that is recorded: a time span and views."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Int64s
from crosscue.replay.errors import UsageError

VIEWS: Final = ("cameras", "ahead", "belief", "ranges", "cues", "map", "pose", "notes")
LAST_NS: Final = 2**63 - 1


@dataclass(frozen=True, slots=True)
class RecordingSpan:
    """The part to record.

    Attributes:
        start_ns: First moment, in the time of the run's tables.
        end_ns: Last moment.
        moment_ns: Moment marked on the time line, or None.
        only: Views to record, from ``VIEWS``; empty for all.
    """

    start_ns: int = 0
    end_ns: int = LAST_NS
    moment_ns: int | None = None
    only: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        """Check the names of the views.

        Raises:
            UsageError: A view does not exist; the message lists those that do.
        """
        strange = sorted(self.only.difference(VIEWS))
        if strange:
            raise UsageError(f"--only {','.join(strange)}: expected some of {','.join(VIEWS)}")

    @property
    def is_whole(self) -> bool:
        """True if the part covers the complete time of the run."""
        return self.start_ns == 0 and self.end_ns == LAST_NS

    def holds(self, t_ns: Int64s) -> NDArray[np.bool_]:
        """Return a mask of the times inside the time span, shape (N,)."""
        return (t_ns >= self.start_ns) & (t_ns <= self.end_ns)

    def shows(self, view: str) -> bool:
        """Return whether a view is selected."""
        return not self.only or view in self.only


WHOLE: Final = RecordingSpan()
