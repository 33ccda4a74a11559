"""Write the truth of data sets and of GNSS, and return the schema of truth files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from crosscue.datasets.truth import truth as truth_file
from crosscue.eval.fit.gnss_truth import write_gnss_truth
from crosscue.eval.logs.log import Log, UnopenedLog, opened
from crosscue.replay.base import DEFAULT_LIMITS, Limits
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given


def write_truth(log: Path | str, output: Path | str, *, limits: Limits = DEFAULT_LIMITS) -> Path:
    """Write the truth that a data set contains: ``truth.json`` and its tracks.

    Args:
        log: Folder of the data set.
        output: Folder for the files.
        limits: Limits for reading the logs.

    Returns:
        The truth file.

    Raises:
        EmptyResultError: The log's format contains no truth.
        OutputError: The files cannot be written.
    """
    with open_log(log, limits) as opened:
        return truth_file.write_carried(opened.format, Path(log), Path(output))


def truth_from_gnss(
    log: Log | UnopenedLog | Path | str,
    output: Path | str,
    vehicle: Vehicle | Path | str | None = None,
) -> Path:
    """Write a drive's GNSS positions as truth: ``truth.json`` and the antenna's track.

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        output: Folder for the files.
        vehicle: Vehicle file with the antenna's mounting, and the standard deviation of positions
            that have none.

    Returns:
        The truth file.

    Raises:
        EmptyResultError: The log has no position, or none with a heading.
        OutputError: The files cannot be written.
    """
    settings = vehicle_given(vehicle)
    with opened(log) as drive:
        return write_gnss_truth(drive.logs, settings, drive.selection, Path(output))


def truth_schema() -> dict[str, Any]:
    """Return the JSON Schema of ``truth.json``, for editors and other tools."""
    return truth_file.json_schema()
