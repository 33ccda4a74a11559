"""The runs of many drives as one folder of tables, each row with its drive's name.

Tables are streamed, so memory does not grow with the number of drives. The merged manifest tells
which drives are in it, which failed and why, and adds up every topic's account.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from crosscue.replay.errors import RunError, one_line
from crosscue.replay.run_folder import (
    MANIFEST,
    RunFolder,
    TableSink,
    clear,
    locked,
    open_run,
    write_manifest,
)

from .run_account import is_whole, summed

if TYPE_CHECKING:
    import pyarrow as pa

STAGE: Final = "merged"
DRIVE: Final = "drive"
FOLDER: Final = "merged"
"""What the merged run is called among those that it was made of."""


@dataclass(frozen=True, slots=True)
class Merged:
    """What was merged.

    Attributes:
        run: The folder that holds all drives' rows.
        drives: How many.
        rows: By table.
        drive_seconds: Log time of all drives, from first to last pose.
    """

    run: RunFolder
    drives: int
    rows: dict[str, int]
    drive_seconds: float


@dataclass(slots=True)
class _Drive:
    name: str
    run: RunFolder
    manifest: dict[str, Any]
    rows: dict[str, int] = field(default_factory=dict)
    first_ns: int | None = None
    last_ns: int | None = None

    @property
    def seconds(self) -> float:
        """From first to last pose."""
        if self.first_ns is None or self.last_ns is None:
            return 0.0
        return (self.last_ns - self.first_ns) * 1e-9


def merge_runs(
    runs: Mapping[str, RunFolder], out: RunFolder, failures: Mapping[str, str]
) -> Merged:
    """Write one table of each kind with a ``drive`` column, and a manifest.

    Args:
        runs: By name, in the order that rows are to have.
        out: Where to; cleared first.
        failures: By name of the drive, why there is no run of it.

    Raises:
        RunError: A run is damaged, or two have columns of one name and different types.
        OutputError: The disk is full.
    """
    drives = [_Drive(name, run, run.manifest()) for name, run in runs.items()]
    kinds = sorted({path.stem for one in drives for path in one.run.path.glob("*.parquet")})
    with locked(out):
        clear(out)
        for kind in kinds:
            _merge_table(kind, drives, out)
        write_manifest(out, _manifest(drives, kinds, failures))
    rows = {kind: sum(one.rows.get(kind, 0) for one in drives) for kind in kinds}
    return Merged(out, len(drives), rows, sum(one.seconds for one in drives))


def _merge_table(kind: str, drives: Sequence[_Drive], out: RunFolder) -> None:
    import pyarrow.compute as pc

    holding = [one for one in drives if one.run.file(f"{kind}.parquet").exists()]
    schema = _schema(kind, holding)
    with TableSink(out, kind, schema) as sink:
        for one in holding:
            one.rows[kind] = 0
            for batch in one.run.batches(kind):
                sink.write(_named(batch, one.name, schema))
                one.rows[kind] += batch.num_rows
                if kind == "pose" and batch.num_rows:
                    times = pc.min_max(batch["t_ns"]).as_py()
                    one.first_ns = times["min"] if one.first_ns is None else one.first_ns
                    one.last_ns = times["max"]


def _named(batch: pa.RecordBatch, drive: str, schema: pa.Schema) -> dict[str, object]:
    import pyarrow as pa

    there = set(batch.schema.names)
    columns: dict[str, object] = {
        name: batch[name] if name in there else pa.nulls(batch.num_rows, schema.field(name).type)
        for name in schema.names
        if name != DRIVE
    }
    return {DRIVE: pa.repeat(pa.scalar(drive), batch.num_rows), **columns}


def _schema(kind: str, holding: Sequence[_Drive]) -> pa.Schema:
    """All columns that any drive has, the drive's name first."""
    import pyarrow as pa

    whole = pa.schema([(DRIVE, pa.string())])
    for one in holding:
        try:
            whole = pa.unify_schemas([whole, one.run.schema(kind)])
        except (pa.ArrowInvalid, pa.ArrowTypeError) as error:
            line = one_line(error)
            raise RunError(
                f"{one.run.path}: {kind}.parquet does not fit those of other drives ({line}); "
                "replay all with one version and one set of features"
            ) from None
    return whole


def _manifest(
    drives: Sequence[_Drive], kinds: Sequence[str], failures: Mapping[str, str]
) -> dict[str, object]:
    return {
        "stage": STAGE,
        "tables": list(kinds),
        "drives": [
            {
                "name": one.name,
                "run": str(one.run.path),
                "logs": [log["path"] for log in one.manifest.get("logs", [])],
                "is_whole": is_whole(one.manifest),
                "rows": one.rows,
                "seconds": one.seconds,
                "tables_sha256": _fingerprint(one),
            }
            for one in drives
        ],
        "failures": dict(sorted(failures.items())),
        "account": summed(one.manifest["account"] for one in drives),
        "notices": dict(Counter(text for one in drives for text in _notices(one)).most_common()),
        "versions": _versions(drives),
        "timings": {
            "seconds": sum(one.manifest.get("timings", {}).get("seconds", 0.0) for one in drives)
        },
    }


def _fingerprint(one: _Drive) -> str:
    """Of the drive's tables as they were merged."""
    digest = hashlib.sha256()
    for kind in sorted(one.rows):
        with one.run.file(f"{kind}.parquet").open("rb") as file:
            digest.update(kind.encode() + b"\0" + hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _notices(one: _Drive) -> set[str]:
    return set(one.manifest.get("notices", []))


def _versions(drives: Sequence[_Drive]) -> dict[str, list[str]]:
    """All that were used: more than one of a library is worth a look."""
    found: dict[str, set[str]] = {}
    for one in drives:
        for library, version in one.manifest.get("versions", {}).items():
            found.setdefault(library, set()).add(version)
    return {library: sorted(used) for library, used in sorted(found.items())}


def open_one(path: Path) -> RunFolder:
    """The run of one drive.

    Raises:
        RunError: It holds many drives; else as ``open_run``.
    """
    run = open_run(path)
    if is_merged(run):
        raise RunError(f"{path}: holds the tables of many drives; give one of the runs beside it")
    return run


def is_merged(run: RunFolder) -> bool:
    """Does it hold many drives?

    Raises:
        RunError: It has no manifest that can be read.
    """
    return run.file(MANIFEST).exists() and run.manifest().get("stage") == STAGE
