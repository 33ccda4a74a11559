"""Report the progress of batches of drives."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

from crosscue.replay.errors import UsageError
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option

from .status import DriveState, DriveStatus, Pace, drives_of_folder, pace_of


@dataclass(frozen=True, slots=True, repr=False)
class BatchStatus(Result):
    """Progress of batches of drives; its text is the output of ``crosscue status``.

    Attributes:
        drives: Run folder, state and error of each drive.
        pace: Drives per hour and seconds left, over all folders.
    """

    drives: tuple[DriveStatus, ...]
    pace: Pace = field(metadata=HIDDEN)

    also: ClassVar = {"per_hour": "pace.per_hour", "seconds_left": "pace.left_s"}

    def count(self, state: str) -> int:
        """Return the number of drives in a state: done, running, failed, stale or waiting."""
        return sum(one.state == state for one in self.drives)

    @property
    def is_whole(self) -> bool:
        """True if no drive has failed or is stale."""
        return not any(self.count(state) for state in (DriveState.FAILED, DriveState.STALE))

    @property
    def exit_status(self) -> int:
        """3 when a drive has failed or is stale, else 0."""
        return 0 if self.is_whole else 3

    @property
    def counts(self) -> dict[str, int]:
        """Number of drives in each state."""
        return {state.value: self.count(state) for state in DriveState}

    def as_dict(self) -> dict[str, object]:
        """Return the number of drives in each state, the pace, and each drive."""
        return {**self.counts, **Result.as_dict(self)}

    def lines(self) -> Iterator[str]:
        """Yield failed and stale drives, the number in each state, and the pace."""
        for one in self.drives:
            if one.error is not None:
                yield f"failed    {one.run.name}: {one.error}"
                if one.log is not None:
                    yield f"          {one.log}"
            elif one.state is DriveState.STALE:
                where = f" on {one.host}" if one.host else ""
                yield f"stale     {one.run.name}: its worker{where} is gone, {_heard(one)}"
        counted = (f"{count} {state}" for state, count in self.counts.items())
        yield f"drives    {len(self.drives)}: {', '.join(counted)}"
        if math.isfinite(self.pace.per_hour):
            digits = 0 if self.pace.per_hour >= 10.0 else 1
            yield f"rate      {self.pace.per_hour:,.{digits}f} drives per hour"
        if math.isfinite(self.pace.left_s):
            yield f"time left {_duration(self.pace.left_s)}"


def _heard(one: DriveStatus) -> str:
    """Return the time since the last sign of a stale drive's worker, and what to do."""
    when = f"last update {_duration(one.silent_s)} ago; " if math.isfinite(one.silent_s) else ""
    return f"{when}replay again"


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60.0)
    if minutes < 2:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def batch_status(*folders: Annotated[Path | str, Option(metavar="RUNS")]) -> BatchStatus:
    """Show the progress of batches of drives.

    A drive is done, running, failed, stale or waiting. It is stale when its worker's process has
    ended or, on another machine, has been silent for two minutes. To process stale and failed
    drives, start the same replay again; to process only failed drives, use replay --retry-failed.
    Nothing is written, so any machine that has access to the folders can show it. The exit status
    is 3 when a drive has failed or is stale.

    Examples:
        crosscue status runs
        crosscue status shards/1 shards/2 --json

    Args:
        folders: Folders that replay writes runs to.

    Raises:
        UsageError: There is no folder, or one is named twice.
        RunError: A folder is missing, or no batch has been written to it.
    """
    places = [Path(folder) for folder in folders]
    if not places or len({place.resolve() for place in places}) < len(places):
        raise UsageError("status: expected folders of runs, each named once")
    found = {place: drives_of_folder(place) for place in places}
    paces = [pace_of(drives, place) for place, drives in found.items()]
    rates = [pace.per_hour for pace in paces if math.isfinite(pace.per_hour)]
    left = [pace.left_s for pace in paces if math.isfinite(pace.left_s)]
    return BatchStatus(
        tuple(one for drives in found.values() for one in drives),
        Pace(sum(rates) if rates else math.nan, max(left, default=math.nan)),
    )
