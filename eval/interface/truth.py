"""The truth that data sets carry, and what a truth file may say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from crosscue.datasets.truth import truth as truth_file
from crosscue.eval.fit.gnss_truth import write_gnss_truth
from crosscue.eval.interface.logs.log import Log, opened
from crosscue.replay.base import DEFAULT_LIMITS, Limits
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given


def write_truth(log: Path | str, output: Path | str, *, limits: Limits = DEFAULT_LIMITS) -> Path:
    """Write the truth that a data set carries: ``truth.json`` and its tracks.

    Args:
        log: Folder of the data set.
        output: Folder for the files.
        limits: What the log is read with.

    Returns:
        The truth file.

    Raises:
        EmptyResultError: The log's format carries no truth.
        OutputError: The files cannot be written.
    """
    with open_log(log, limits) as opened:
        return truth_file.write_carried(opened.format, Path(log), Path(output))


def truth_from_gnss(
    log: Log | Path | str, output: Path | str, vehicle: Vehicle | Path | str | None = None
) -> Path:
    """Write a drive's own GNSS as truth: ``truth.json`` and the antenna's track.

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        output: Folder for the files.
        vehicle: The vehicle file: the antenna's place, and how good positions are that do not say.

    Returns:
        The truth file.

    Raises:
        EmptyResultError: No position, or none with a heading.
        OutputError: The files cannot be written.
    """
    settings = vehicle_given(vehicle)
    with opened(log) as drive:
        return write_gnss_truth(drive.logs, settings, drive.selection, Path(output))


def truth_schema() -> dict[str, Any]:
    """The JSON Schema of ``truth.json``, for editors and other tools."""
    return truth_file.json_schema()
