"""What of a run is recorded: some time of it, some of its views."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from crosscue.replay.errors import UsageError

VIEWS: Final = ("cameras", "ahead", "belief", "ranges", "cues", "map", "pose", "notes")
LAST_NS: Final = 2**63 - 1


@dataclass(frozen=True, slots=True)
class Part:
    """What to record.

    Attributes:
        start_ns: First moment, as in the run's tables.
        end_ns: Last moment.
        moment_ns: Marked on the time line; None for none.
        only: Of ``VIEWS``; empty for all.
    """

    start_ns: int = 0
    end_ns: int = LAST_NS
    moment_ns: int | None = None
    only: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        """Refuse views that there are not.

        Raises:
            UsageError: With their names.
        """
        strange = sorted(self.only.difference(VIEWS))
        if strange:
            raise UsageError(f"--only {strange[0]}: expected some of {','.join(VIEWS)}")

    @property
    def is_whole(self) -> bool:
        """Nothing is cut off."""
        return self.start_ns == 0 and self.end_ns == LAST_NS

    def shows(self, view: str) -> bool:
        """Is a view wanted?"""
        return not self.only or view in self.only


WHOLE: Final = Part()
