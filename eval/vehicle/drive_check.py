"""Check of a vehicle file on a few seconds of a drive, as a table, a page or a picture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from crosscue.eval.logs.log import Log, UnopenedLog, opened
from crosscue.replay.base import name_of
from crosscue.replay.errors import EmptyResultError
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given
from crosscue.results import HIDDEN, Result, json_key, listing

from .check import Checked, check_drive_signals
from .check_page import check_report_place, write_check

HEAD = ("signal", "read from", "readings", "rate_hz", "lowest", "highest", "unit")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class VehicleCheck(Result):
    """Signals of a drive as decoded with a vehicle file, and their contradictions.

    Attributes:
        path: The page or picture; None if it was not requested.
        part: Seconds of the drive that were examined, in words.
        found: The signals, and the picture.
    """

    path: Path | None = field(metadata=json_key("page"))
    part: str
    found: Checked = field(metadata=HIDDEN)

    also: ClassVar = {
        "contradictions": "contradictions",
        "signals": "found.signals",
        "missing": "found.missing",
        "picture": "picture",
    }

    @property
    def contradictions(self) -> tuple[str, ...]:
        """Contradictions between signals, one sentence each."""
        return self.found.contradictions

    @property
    def exit_status(self) -> int:
        """1 when signals contradict each other, else 0."""
        return 1 if self.contradictions else 0

    @property
    def picture(self) -> dict[str, object] | None:
        """Topic, time and size of the picture that was checked; None without a camera."""
        shown = self.found.picture
        if shown is None:
            return None
        height, width = shown.pixels.shape[:2]
        return {"topic": shown.topic, "t_ns": shown.t_ns, "size_px": (width, height)}

    def lines(self) -> Iterator[str]:
        """Yield a table of the signals, and what agrees or contradicts."""
        signals = self.found.signals
        rows = [
            (row.signal, row.source, row.count, row.rate_hz, row.low, row.high, row.unit)
            for row in signals
        ]
        yield from (
            f"examined {self.part}",
            "",
            listing(HEAD, rows, 2) if rows else "no signal",
            "",
        )
        yield from (f"agrees   {row.signal}: {row.agrees}" for row in signals if row.agrees)
        yield from (f"not read {signal}: {why}" for signal, why in self.found.missing.items())
        yield from [f"WRONG    {text}" for text in self.contradictions] or [
            "no contradiction found"
        ]
        if self.path is not None:
            yield str(self.path)


def check_vehicle(
    log: Log | UnopenedLog | Path | str,
    vehicle: Vehicle | Path | str,
    output: Path | str | None = None,
    *,
    start_s: float = 0.0,
    seconds: float = 10.0,
    overwrite: bool = False,
) -> VehicleCheck:
    """Check a vehicle file on part of a drive, and list contradictions.

    The values of each signal are listed. The page shows a picture with the horizon, distances along
    the road, and the regions searched for road. The exit status is 1 when signals contradict each
    other.

    Args:
        log: The drive, or its path.
        vehicle: The vehicle file to check.
        output: Page (.html) or picture (.jpg, .png) to write.
        start_s: Start this many seconds after the first message.
        seconds: Seconds of the log to read.
        overwrite: Replace an existing file.

    Raises:
        VehicleError: The vehicle file does not fit the drive.
        UsageError: The time span is out of range, or the output is neither a page nor a picture.
        OutputError: The file exists, or cannot be written.
        EmptyResultError: Those seconds contain neither a signal nor a picture.
    """
    path = None if output is None else Path(output)
    if path is not None:
        check_report_place(path, overwrite)
    settings = vehicle_given(vehicle)
    with opened(log) as drive:
        part = drive.part(start_s, start_s + seconds)
        found = check_drive_signals(part.logs, settings, part.selection)
        names = [name_of(one) for one in part.logs]
    words = f"{seconds:g} s starting at {start_s:g} s"
    if not found.signals and found.picture is None:
        why = "; ".join(f"{signal}: {text}" for signal, text in found.missing.items())
        raise EmptyResultError(f"{', '.join(names)}: {words}: no signal and no picture: {why}")
    if path is not None:
        write_check(path, found, settings, names, words)
    return VehicleCheck(path, words, found)
