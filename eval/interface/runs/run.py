"""A run, read back as tables."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crosscue.eval.interface.show import listing
from crosscue.eval.runs.folder import Manifest, RunFolder, json_schema
from crosscue.eval.runs.folder import open_run as open_folder
from crosscue.replay.base import DEFAULT_LIMITS, Limits, RunError, UsageError
from crosscue.replay.vehicle.vehicle import Vehicle, load

if TYPE_CHECKING:
    import pyarrow as pa

    from crosscue.eval.pipeline.outcome import DetectOutcome, Outcome


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Run:
    """A run folder; ``replay_drive`` makes one, ``open_run`` reads one.

    Its tables are read when asked for, their checksums verified: ``run["belief"]``, or
    ``run.belief`` for those that every replay has.

    Attributes:
        folder: Where its files are.
        outcome: What the replay or estimate that made it counted; None for a run read from disk.
    """

    folder: RunFolder
    outcome: Outcome | DetectOutcome | None = None

    @property
    def path(self) -> Path:
        """Its folder."""
        return self.folder.path

    @property
    def made(self) -> Outcome | DetectOutcome:
        """What the replay, detection or estimate that made it counted.

        Raises:
            UsageError: The run was read from disk.
        """
        if self.outcome is None:
            raise UsageError(f"{self.path}: read from disk; its manifest holds what was counted")
        return self.outcome

    @property
    def manifest(self) -> Manifest:
        """Its logs, versions and settings, and the account of every row."""
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
        """Every object that detectors found."""
        return self["detections"]

    @property
    def pose(self) -> pa.Table:
        """Position, heading and their covariance over time."""
        return self["pose"]

    def __repr__(self) -> str:
        rows = []
        for name in self.tables:
            columns = self.folder.schema(name).names
            rows.append((name, ", ".join(columns), self._rows(name)))
        return f"{self.path}\n{listing(('table', 'columns', 'rows'), rows, 2)}"

    def _rows(self, name: str) -> int:
        import pyarrow.parquet as pq

        return int(pq.read_metadata(self.folder.file(f"{name}.parquet")).num_rows)


def load_vehicle(path: Path | str) -> Vehicle:
    """Read and check a vehicle file.

    Raises:
        VehicleError: It is missing, or a value does not fit; the message names the field.
    """
    return load(Path(path))


def open_run(
    path: Path | str,
    logs: Path | str | None = None,
    *,
    without_images: bool = False,
    limits: Limits = DEFAULT_LIMITS,
) -> Run:
    """Open a finished run.

    Args:
        path: Its folder.
        logs: Where its logs have moved to, if they have.
        without_images: Show it without the images in its logs, which may be gone.
        limits: What its logs are read with.

    Raises:
        RunError: It is not a run, damaged, of another version, or holds many drives merged.
    """
    moved = None if logs is None else Path(logs)
    folder = open_folder(Path(path), moved, without_images=without_images, limits=limits)
    # Refuses a folder of many drives merged.
    folder.drive_manifest()
    return Run(folder)


def run_schema() -> dict[str, Any]:
    """The JSON Schema of a run's ``manifest.json``, for editors and other tools."""
    return json_schema()


def run_given(run: Run | Path | str) -> Run:
    """A run as it is, or that of a folder."""
    return run if isinstance(run, Run) else open_run(run)
