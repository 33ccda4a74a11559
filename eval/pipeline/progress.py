"""Progress callbacks of the stages: frames done, and seconds of the drive done."""

from __future__ import annotations

from collections.abc import Callable

from crosscue.replay.time.segments import Timeline

OnTime = Callable[[float, float], None]
"""Callback for the seconds of a drive that are done, and the total."""


def unwatched_time(_done_s: float, _of_s: float) -> None:
    """Ignore the progress."""


def report_time(on_time: OnTime, timeline: Timeline, t_ns: int) -> None:
    """Call ``on_time`` for a drive that has been processed up to ``t_ns``."""
    first, last = timeline.segments[0], timeline.segments[-1]
    if last.end_ns > first.start_ns:
        # The last window ends after the last wheel speed.
        on_time(
            (min(t_ns, last.end_ns) - first.start_ns) * 1e-9, (last.end_ns - first.start_ns) * 1e-9
        )


OnFrames = Callable[[int, int | None], None]
"""Callback for the number of frames done, and the total if known."""


def no_progress(_done: int, _of: int | None) -> None:
    """Ignore the progress."""
