"""Progress of the stages, in seconds of the drive."""

from __future__ import annotations

from crosscue.replay.progress import Progress, emit
from crosscue.replay.time.segments import Timeline


def report_time(doing: str, timeline: Timeline, t_ns: int) -> None:
    """Report a drive that has been processed up to ``t_ns``."""
    first, last = timeline.segments[0], timeline.segments[-1]
    if last.end_ns > first.start_ns:
        # The last window ends after the last wheel speed.
        done_s = (min(t_ns, last.end_ns) - first.start_ns) * 1e-9
        emit(Progress(doing, done_s, (last.end_ns - first.start_ns) * 1e-9, "s of log"))
