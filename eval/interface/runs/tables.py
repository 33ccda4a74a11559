"""Decode a drive into tables, and merge the tables of runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.eval.interface.logs.log import Log, opened
from crosscue.eval.runs.folder import created
from crosscue.replay.base import RunError, visible

from .make import vehicle_of

if TYPE_CHECKING:
    from crosscue.eval.catalog.decoded_logs import Decoded
    from crosscue.replay.vehicle.vehicle import Vehicle


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


def decode(
    log: Log | Path | str,
    output: Path | str,
    vehicle: Vehicle | Path | str | None = None,
    *,
    overwrite: bool = False,
    on_rows: Callable[[int, int], None] = lambda done, of: None,
) -> Decoded:
    """Write each topic, CAN message and Mobileye table of a drive as a Parquet file.

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        output: Folder for the tables.
        vehicle: Vehicle file with DBC files, buses and mounting; None for the ``vehicle.toml`` next
            to the log, if it exists.
        overwrite: Replace earlier tables.
        on_rows: Called with the number of rows read, and the number that the logs declare.

    Raises:
        SchemaError: A DBC file is not valid.
        EmptyResultError: There is no row for any table; the folder is unchanged.
        OutputError: The folder has other contents, or cannot be written.
    """
    from crosscue.eval.catalog.decoded_logs import decode_tables

    with opened(log) as drive:
        settings = vehicle_of(drive, vehicle)
        with created(Path(output), overwrite=overwrite) as folder:
            return decode_tables(drive.logs, settings, folder, drive.selection, on_rows)


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
