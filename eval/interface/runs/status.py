"""Report the progress of batches of drives."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from crosscue.eval.batch.status import (
    DriveState,
    DriveStatus,
    Pace,
    drives_of_folder,
    pace_of,
)
from crosscue.replay.base import UsageError, visible


@dataclass(frozen=True, slots=True, repr=False)
class BatchStatus:
    """Progress of batches of drives; its repr is the output of ``crosscue status``.

    Attributes:
        drives: Run folder, state and error of each drive.
        pace: Drives per hour and seconds left, over all folders.
    """

    drives: tuple[DriveStatus, ...]
    pace: Pace

    def count(self, state: str) -> int:
        """Return the number of drives in a state: done, running, failed, stale or waiting."""
        return sum(one.state == state for one in self.drives)

    @property
    def is_whole(self) -> bool:
        """True if no drive has failed or is stale."""
        return not any(self.count(state) for state in (DriveState.FAILED, DriveState.STALE))

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue status``."""
        states = Counter(one.state.value for one in self.drives)
        return {
            **{state.value: states[state.value] for state in DriveState},
            "per_hour": self.pace.per_hour,
            "seconds_left": self.pace.left_s,
            "drives": [
                {
                    "run": str(one.run),
                    "state": one.state.value,
                    "silent_s": one.silent_s,
                    "host": one.host,
                    "error": one.error,
                    "log": None if one.log is None else str(one.log),
                }
                for one in self.drives
            ],
        }

    def __repr__(self) -> str:
        lines = []
        for one in self.drives:
            if one.error is not None:
                lines.append(f"failed    {one.run.name}: {one.error}")
                lines += [] if one.log is None else [f"          {one.log}"]
            elif one.state is DriveState.STALE:
                where = f" on {one.host}" if one.host else ""
                lines.append(f"stale     {one.run.name}: its worker{where} is gone, {_heard(one)}")
        total = len(self.drives)
        counted = (f"{self.count(state)} {state}" for state in DriveState)
        lines.append(f"drives    {total}: {', '.join(counted)}")
        if math.isfinite(self.pace.per_hour):
            digits = 0 if self.pace.per_hour >= 10.0 else 1
            lines.append(f"rate      {self.pace.per_hour:,.{digits}f} drives per hour")
        if math.isfinite(self.pace.left_s):
            lines.append(f"time left {_duration(self.pace.left_s)}")
        return "\n".join(map(visible, lines))


def _heard(one: DriveStatus) -> str:
    """Return the time since the last sign of a stale drive's worker, and what to do."""
    when = f"last update {_duration(one.silent_s)} ago; " if math.isfinite(one.silent_s) else ""
    return f"{when}replay again"


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60.0)
    if minutes < 2:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def batch_status(*folders: Path | str) -> BatchStatus:
    """Return the states of the drives in folders of runs.

    A state is done, running, failed, stale or waiting. Nothing is written, so the function works on
    any machine that has access to the folders.

    Args:
        folders: Output folders of ``replay_drives``, of one batch or several.

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
