"""Drives and runs as tables on disk: a drive decoded, runs merged."""

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
    """Runs of many drives in one folder of tables.

    Attributes:
        path: The folder.
        drives: Names of the drives, each in the column ``drive`` of its rows.
        failures: By name of a drive without a run, why.
        rows: By table.
    """

    path: Path
    drives: tuple[str, ...]
    failures: Mapping[str, str]
    rows: Mapping[str, int]

    def as_dict(self) -> dict[str, object]:
        """What ``crosscue merge --json`` prints."""
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
    """Write every stream of a drive as a Parquet file: topics, CAN messages, Mobileye tables.

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        output: Folder for the tables.
        vehicle: DBC files, buses and mounting; None for the ``vehicle.toml`` beside the log, if
            there is one.
        overwrite: Replace earlier tables.
        on_rows: Called with the rows that are read, and those that the logs declare.

    Raises:
        SchemaError: A DBC file cannot be understood.
        EmptyResultError: No row for any table; the folder is as it was.
        OutputError: The folder holds something else, or cannot be written.
    """
    from crosscue.eval.catalog.decoded_logs import decode_tables

    with opened(log) as drive:
        settings = vehicle_of(drive, vehicle)
        with created(Path(output), overwrite=overwrite) as folder:
            return decode_tables(drive.logs, settings, folder, drive.selection, on_rows)


def merge(
    folders: Sequence[Path | str], output: Path | str, *, overwrite: bool = False
) -> MergedRuns:
    """Merge the runs of batches into one folder of tables, each row with its drive's name.

    A set union: the order does not matter, and a run that is in two batches counts once.

    Args:
        folders: Run folders, or folders of them.
        output: Folder for the tables.
        overwrite: Replace earlier tables.

    Raises:
        RunError: No finished run, or one that is damaged.
        UsageError: Two different runs have one name.
    """
    from crosscue.eval.batch.merge import gathered, merge_runs

    places = [Path(folder) for folder in folders]
    runs, failures = gathered(places)
    if not runs:
        raise RunError(f"{places[0]}: no finished run in it; replay first")
    with created(Path(output), overwrite=overwrite) as folder:
        merged = merge_runs(runs, folder, failures)
    return MergedRuns(merged.run.path, tuple(sorted(runs)), failures, merged.rows)
