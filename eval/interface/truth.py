"""The truth that data sets carry, and what a truth file may say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from crosscue.datasets.truth import truth as truth_file
from crosscue.replay.base import DEFAULT_LIMITS, Limits
from crosscue.replay.logs.opening import open_log


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


def truth_schema() -> dict[str, Any]:
    """The JSON Schema of ``truth.json``, for editors and other tools."""
    return truth_file.json_schema()
