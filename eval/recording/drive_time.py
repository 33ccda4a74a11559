"""The one timeline of a recording: the log's clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

TIMELINE: Final = "drive"
"""Not ``log_time``: under that name the viewer keeps the wall clock of the logging itself."""
YEAR_2000_NS: Final = 946_684_800_000_000_000


@dataclass(frozen=True, slots=True)
class DriveTime:
    """How a drive's times are shown.

    Attributes:
        is_date: As dates; else as durations, for logs on a clock that begins with the machine.
    """

    is_date: bool

    def column(self, t_ns: NDArray[np.int64] | Sequence[int]) -> list[rr.TimeColumn]:
        """The index of ``send_columns`` for rows at these times."""
        times = np.asarray(t_ns, np.int64)
        if self.is_date:
            return [rr.TimeColumn(TIMELINE, timestamp=times.astype("datetime64[ns]"))]
        return [rr.TimeColumn(TIMELINE, duration=times.astype("timedelta64[ns]"))]


def time_of(first_ns: int) -> DriveTime:
    """For a drive that begins then."""
    return DriveTime(first_ns > YEAR_2000_NS)
