"""Merge the runs of batches into one folder of tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from crosscue.eval.runs.folder import created
from crosscue.replay.errors import RunError
from crosscue.results import Result, json_key
from crosscue.verb import Option

from .merge import gathered, merge_runs


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MergedRuns(Result):
    """Merged tables of the runs of many drives.

    Attributes:
        path: Folder of the tables.
        drives: Names of the drives, as in the column ``drive`` of the tables.
        failures: Errors by name of the drives without a run.
        rows: Numbers of rows by table.
    """

    path: Path = field(metadata=json_key("merged"))
    drives: tuple[str, ...]
    failures: Mapping[str, str]
    rows: Mapping[str, int]

    @property
    def exit_status(self) -> int:
        """3 when a drive of a batch has failed, else 0."""
        return 3 if self.failures else 0

    def lines(self) -> Iterator[str]:
        """Yield failures, the number of drives, and where the tables are."""
        yield from (f"failed   {name}: {why}" for name, why in sorted(self.failures.items()))
        yield f"drives   {len(self.drives)}, {len(self.failures)} failed"
        yield f"tables   {self.path}"


def merge(
    folders: Annotated[Sequence[Path | str], Option(metavar="RUNS")],
    output: Annotated[Path | str, Option(metavar="ALL")],
    *,
    overwrite: bool = False,
) -> MergedRuns:
    """Merge the runs of several batches into one folder of tables.

    Each row has the drive's name. The result is a set union: the order does not matter, and a run
    that is in two batches counts once. Two different runs of the same name are refused. A single
    batch over all drives yields the same bytes.

    Examples:
        crosscue merge shards/1 shards/2 -o all

    Args:
        folders: Folders of runs, or run folders.
        output: Folder for the tables.
        overwrite: Replace existing tables.

    Raises:
        RunError: There is no finished run, or a run is damaged.
        UsageError: Two different runs have the same name.
    """
    places = [Path(folder) for folder in folders]
    runs, failures = gathered(places)
    if not runs:
        raise RunError(f"{places[0]}: contains no finished run; replay first")
    with created(Path(output), overwrite=overwrite) as folder:
        merged = merge_runs(runs, folder, failures)
    return MergedRuns(merged.run.path, tuple(sorted(runs)), failures, merged.rows)
