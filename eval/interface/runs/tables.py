"""Decode a drive into tables, and merge the tables of runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.eval.runs.folder import created
from crosscue.replay.base import RunError, visible

if TYPE_CHECKING:
    pass


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MergedRuns:
    """Merged tables of the runs of many drives.

    Attributes:
        path: Folder of the tables.
        drives: Names of the drives, as in the column ``drive`` of the tables.
        failures: Errors by name of the drives without a run.
        rows: Numbers of rows by table.
    """

    path: Path
    drives: tuple[str, ...]
    failures: Mapping[str, str]
    rows: Mapping[str, int]

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue merge``."""
        return {
            "merged": str(self.path),
            "drives": list(self.drives),
            "failures": dict(self.failures),
            "rows": dict(self.rows),
        }

    def __repr__(self) -> str:
        lines = [
            *(f"failed   {name}: {why}" for name, why in sorted(self.failures.items())),
            f"drives   {len(self.drives)}, {len(self.failures)} failed",
            f"tables   {self.path}",
        ]
        return "\n".join(visible(line) for line in lines)


def merge(
    folders: Sequence[Path | str], output: Path | str, *, overwrite: bool = False
) -> MergedRuns:
    """Merge the runs of batches into one folder of tables, with the drive's name in each row.

    The result is a set union: the order does not matter, and a run that is in two batches counts
    once.

    Args:
        folders: Run folders, or folders of them.
        output: Folder for the tables.
        overwrite: Replace earlier tables.

    Raises:
        RunError: There is no finished run, or a run is damaged.
        UsageError: Two different runs have the same name.
    """
    from crosscue.eval.batch.merge import gathered, merge_runs

    places = [Path(folder) for folder in folders]
    runs, failures = gathered(places)
    if not runs:
        raise RunError(f"{places[0]}: contains no finished run; replay first")
    with created(Path(output), overwrite=overwrite) as folder:
        merged = merge_runs(runs, folder, failures)
    return MergedRuns(merged.run.path, tuple(sorted(runs)), failures, merged.rows)
