"""Write the truth that a data set contains."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from crosscue.replay.limits import DEFAULT_LIMITS, LimitsGiven
from crosscue.replay.logs.opening import open_log
from crosscue.results import Result, json_key

from .truth import write_carried


@dataclass(frozen=True, slots=True, repr=False)
class WrittenTruth(Result):
    """A truth file that was written.

    Attributes:
        path: The file.
    """

    path: Path = field(metadata=json_key("truth"))

    def lines(self) -> Iterator[str]:
        """Yield the path."""
        yield str(self.path)


def write_truth(
    log: Path | str, output: Path | str, *, limits: LimitsGiven = DEFAULT_LIMITS
) -> WrittenTruth:
    """Write the truth that a data set contains.

    The result is truth.json and a TUM trajectory.

    Examples:
        crosscue truth comma2k19/Example_1/ROUTE/40 -o truth/

    Args:
        log: Folder of a data set.
        output: Folder for the truth file and its trajectory.
        limits: Limits for reading the logs.

    Raises:
        EmptyResultError: The log's format contains no truth.
        OutputError: The files cannot be written.
    """
    with open_log(log, limits) as opened:
        return WrittenTruth(write_carried(opened.format, Path(log), Path(output)))
