"""Read runs as tables."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.folder import open_run as open_folder
from crosscue.eval.runs.manifest import Manifest
from crosscue.replay.errors import LogError, RunError, UsageError
from crosscue.replay.limits import DEFAULT_LIMITS, LimitsGiven
from crosscue.replay.safe_text import visible
from crosscue.replay.vehicle.vehicle import Vehicle, load
from crosscue.results import Result, listing
from crosscue.verb import Option

if TYPE_CHECKING:
    import pyarrow as pa

    from crosscue.eval.pipeline.outcome import DetectOutcome, Outcome


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Run(Result):
    """A run folder, made by ``replay_drive`` or read by ``open_run``.

    Tables are read on access, and their checksums are verified: ``run["belief"]``, or
    ``run.belief`` for the tables that every replay has.

    Attributes:
        folder: Folder with its files.
        outcome: Counts of the replay, detection or estimate that made it; None for a run read from
            disk.
    """

    folder: RunFolder
    outcome: Outcome | DetectOutcome | None = None

    @property
    def path(self) -> Path:
        """Path of its folder."""
        return self.folder.path

    @property
    def reported(self) -> Result:
        """The counts, which the commands that make a run print."""
        return self.made

    @property
    def made(self) -> Outcome | DetectOutcome:
        """Counts of the replay, detection or estimate that made it.

        Raises:
            UsageError: The run was read from disk.
        """
        if self.outcome is None:
            raise UsageError(f"{self.path}: read from disk; use the counts in its manifest")
        return self.outcome

    @property
    def manifest(self) -> Manifest:
        """Logs, versions, settings, and the account of every row."""
        return self.folder.manifest()

    @property
    def tables(self) -> tuple[str, ...]:
        """Names of its tables."""
        return tuple(sorted(path.stem for path in self.path.glob("*.parquet")))

    def __getitem__(self, table: str) -> pa.Table:
        if table not in self.tables:
            raise RunError(f"{self.path}: no table {table!r}; there are: {', '.join(self.tables)}")
        return self.folder.table(table)

    @property
    def belief(self) -> pa.Table:
        """Probability of every feature over time."""
        return self["belief"]

    @property
    def cues(self) -> pa.Table:
        """Count of every cue in every frame."""
        return self["cues"]

    @property
    def detections(self) -> pa.Table:
        """Objects found by detectors."""
        return self["detections"]

    @property
    def pose(self) -> pa.Table:
        """Position, heading and their covariance over time."""
        return self["pose"]

    def lines(self) -> Iterator[str]:
        """Yield the folder, a table of tables, and notices."""
        rows = []
        for name in self.tables:
            columns = self.folder.schema(name).names
            rows.append((name, ", ".join(columns), self._rows(name)))
        yield str(self.path)
        yield listing(("table", "columns", "rows"), rows, 2)
        yield from (f"note: {visible(text)}" for text in self.folder.drive_manifest().notices)

    def _rows(self, name: str) -> int:
        import pyarrow.parquet as pq

        return int(pq.read_metadata(self.folder.file(f"{name}.parquet")).num_rows)


def load_vehicle(path: Path | str) -> Vehicle:
    """Read and check a vehicle file.

    Raises:
        VehicleError: The file is missing, or a value is not valid; the message names the field.
    """
    return load(Path(path))


def open_run(
    run: Path | str,
    logs: Annotated[Path | str | None, Option(metavar="DIR")] = None,
    *,
    without_images: bool = False,
    limits: LimitsGiven = DEFAULT_LIMITS,
) -> Run:
    """Open a finished run.

    Args:
        run: Folder of the run.
        logs: Folder that the run's logs have moved to; they are recognised by content.
        without_images: Leave out camera images, so the run's logs are not needed.
        limits: Limits for reading its logs.

    Raises:
        RunError: The folder is not a run, is damaged or of another version, or contains merged
            drives.
    """
    folder = open_folder(Path(run), moved_to(logs), without_images=without_images, limits=limits)
    # Refuses a folder of merged drives.
    folder.drive_manifest()
    return Run(folder)


def moved_to(logs: Path | str | None) -> Path | None:
    """Return the folder that the logs of runs have moved to.

    Raises:
        LogError: It is not a folder.
    """
    if logs is not None and not Path(logs).is_dir():
        raise LogError(f"logs: {logs}, no such folder; name the one that the logs have moved to")
    return None if logs is None else Path(logs)


def open_run_of_logs(
    run: Path | str,
    logs: Annotated[Path | str | None, Option(metavar="DIR")] = None,
    limits: LimitsGiven = DEFAULT_LIMITS,
) -> Run:
    """Open a finished run, for a verb that shows no pictures.

    Args:
        run: Run folder.
        logs: Folder that the run's logs have moved to; they are recognised by content.
        limits: Limits for reading its logs.
    """
    return open_run(run, logs, limits=limits)


# A run, as a parameter of a verb: on the command line, ``RUN`` and where its logs are.
RunGiven: TypeAlias = Annotated[Run | Path | str, Option(made_by=open_run_of_logs)]
# A run of a verb that shows its pictures, unless ``--without-images`` is set.
PicturedRun: TypeAlias = Annotated[Run | Path | str, Option(made_by=open_run)]


def run_given(run: Run | Path | str) -> Run:
    """Return a run unchanged, or open the run of a folder."""
    return run if isinstance(run, Run) else open_run(run)
