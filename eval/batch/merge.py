"""Merging of the runs of many drives into one run folder whose rows carry the drive's name.

Tables are streamed, so memory does not grow with the number of drives. The merged manifest lists
the drives, the failed drives with their errors, and the sums of every topic's account. Merging is a
set union: the order does not matter, and a run that is found twice counts once. The output has the
same bytes however the drives were distributed over batches.
"""

import hashlib
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final

import pyarrow as pa

from crosscue.eval.runs.account import sum_accounts
from crosscue.eval.runs.folder import (
    MANIFEST,
    RunFolder,
    clear,
    created,
    locked,
    open_run,
    staged,
    write_manifest,
)
from crosscue.eval.runs.manifest import (
    DriveManifest,
    EstimateManifest,
    MergedDrive,
    MergedLog,
    MergedManifest,
)
from crosscue.eval.runs.settings_hash import text_and_sha256
from crosscue.eval.runs.tables.columns import DRIVE, arrow_schema
from crosscue.eval.runs.tables.parquet import TableSink
from crosscue.eval.runs.tags import read_tags
from crosscue.replay.errors import RunError, UnreadableRunError, UsageError, one_line
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import spelled
from crosscue.results import Result, json_key
from crosscue.verb import Option

from .journal import MERGED, NO_RUN, unfinished

FOLDER: Final = MERGED


@dataclass(slots=True)
class _Drive:
    name: str
    run: RunFolder
    manifest: DriveManifest
    rows: dict[str, int] = field(default_factory=dict)
    first_ns: int | None = None
    last_ns: int | None = None

    @property
    def seconds(self) -> float:
        if self.first_ns is None or self.last_ns is None:
            return 0.0
        return (self.last_ns - self.first_ns) * 1e-9


def merge_runs(
    runs: Mapping[str, RunFolder], out: RunFolder, failures: Mapping[str, str]
) -> dict[str, int]:
    """Write one table of each kind with a ``drive`` column, and a manifest.

    Args:
        runs: Runs by drive name; rows are in the order of names.
        out: Output folder; cleared first.
        failures: Reason why a drive has no run, by drive name.

    Returns:
        Number of rows by table.

    Raises:
        RunError: A run is damaged, or a column has different types in two runs.
        OutputError: The disk is full.
    """
    drives = [
        _Drive(spelled(name), run, run.drive_manifest()) for name, run in sorted(runs.items())
    ]
    kinds = sorted({path.stem for one in drives for path in one.run.path.glob("*.parquet")})
    with locked(out), staged(out, always=True) as new:
        clear(new)
        for kind in kinds:
            _merge_table(kind, drives, new)
        write_manifest(new, _manifest(drives, kinds, failures))
    return {kind: sum(one.rows.get(kind, 0) for one in drives) for kind in kinds}


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
    there = set(batch.schema.names)
    columns: dict[str, object] = {
        name: batch[name] if name in there else pa.nulls(batch.num_rows, schema.field(name).type)
        for name in schema.names
        if name not in DRIVE
    }
    return {"drive": pa.repeat(pa.scalar(drive), batch.num_rows), **columns}


def _schema(kind: str, holding: Sequence[_Drive]) -> pa.Schema:
    """Return the columns of all drives, preceded by the drive's name."""
    whole = arrow_schema(DRIVE)
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
) -> MergedManifest:
    return MergedManifest(
        tables=tuple(kinds),
        drives=tuple(
            MergedDrive(
                name=one.name,
                logs=tuple(
                    MergedLog(name=log.name, identity=log.identity) for log in one.manifest.logs
                ),
                settings_sha256=_settings_hash(one.manifest),
                is_whole=one.manifest.account.is_whole,
                rows=one.rows,
                seconds=one.seconds,
                tables_sha256=_tables_hash(one.run),
                tags=read_tags(one.run.path),
            )
            for one in drives
        ),
        failures={spelled(name): why for name, why in sorted(failures.items())},
        account=sum_accounts(one.manifest.account for one in drives),
        notices=dict(
            Counter(text for one in drives for text in {*one.manifest.notices}).most_common()
        ),
        versions=_versions(drives),
    )


def _settings_hash(manifest: DriveManifest) -> str:
    detected = manifest.detect if isinstance(manifest, EstimateManifest) else None
    return text_and_sha256(
        manifest.settings.model_dump(mode="json"),
        None if detected is None else [one.as_json() for one in detected.detectors],
        manifest.selection.as_json(),
    )[1]


def _tables_hash(run: RunFolder) -> str:
    digest = hashlib.sha256()
    for path in sorted(run.path.glob("*.parquet")):
        with os.fdopen(door.opened(path), "rb") as file:
            digest.update(path.stem.encode() + b"\0")
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def gathered(folders: Sequence[Path]) -> tuple[dict[str, RunFolder], dict[str, str]]:
    """Return all runs of batches, and the reasons why other drives have no run.

    A drive that was planned but not done is among the latter, so that no drive is omitted silently.

    Args:
        folders: Run folders, or folders of run folders as ``replay`` of many drives writes them.

    Returns:
        Runs by drive name, and the reason by name of each drive without a run.

    Raises:
        UsageError: Two different runs have one name, or copies of a run have different tags.
        RunError: A run is damaged or of another version.
    """
    runs: dict[str, RunFolder] = {}
    reasons: dict[str, set[str]] = {}
    for folder in folders:
        missing = unfinished(folder)
        for run in _finished(folder):
            path = run.path
            if path.name in missing:
                # The run has other settings: the last attempt, meant to replace it, failed.
                continue
            first = runs.setdefault(path.resolve().name, run)
            if first is not run and _content(first) != _content(run):
                raise UsageError(
                    f"{first.path} and {path}: two different runs have one name, and merging would "
                    "drop one; rename it, or replay both with the same settings"
                )
            if read_tags(first.path) != read_tags(path):
                raise UsageError(
                    f"{first.path} and {path}: one run with different tags, and merging would drop "
                    "some; set the same tags with crosscue tag"
                )
        merged = _merged_in(RunFolder(folder / FOLDER))
        reported = {} if merged is None else merged.failures
        for name, why in (reported | missing).items():
            reasons.setdefault(name, set()).add(why)
    # Independent of the order of folders; an error takes precedence over "no run yet".
    chosen = {
        name: min(whys, key=lambda why: (why.startswith(NO_RUN), why))
        for name, whys in reasons.items()
        if name not in runs
    }
    return runs, dict(sorted(chosen.items()))


def _finished(folder: Path) -> Iterator[RunFolder]:
    """Yield the single-drive runs in a folder, or the folder itself; read each manifest once."""
    if folder.joinpath(MANIFEST).exists():
        if is_merged(RunFolder(folder)):
            raise UsageError(f"{folder}: already merged; expected the folder that holds the runs")
        yield open_run(folder)
        return
    try:
        inside = sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    except OSError as error:
        raise UnreadableRunError(f"{folder}: {error.strerror}; expected a folder of runs") from None
    for entry in inside:
        run = RunFolder(entry)
        if entry.joinpath(MANIFEST).exists() and not is_merged(run):
            yield run


def _content(run: RunFolder) -> tuple[str, ...]:
    """Return what identifies equal runs: logs, settings and the content of every table."""
    manifest = run.drive_manifest()
    logs = sorted(log.identity.digest for log in manifest.logs)
    return (*logs, _settings_hash(manifest), _tables_hash(run))


def _versions(drives: Sequence[_Drive]) -> dict[str, tuple[str, ...]]:
    """Return all versions of each library; more than one is worth checking."""
    found: dict[str, set[str]] = {}
    for one in drives:
        for library, version in one.manifest.versions.items():
            found.setdefault(library, set()).add(version)
    return {library: tuple(sorted(used)) for library, used in sorted(found.items())}


def is_merged(run: RunFolder) -> bool:
    """Return whether a run folder holds many drives.

    Raises:
        RunError: It has no readable manifest.
    """
    return _merged_in(run) is not None


def _merged_in(run: RunFolder) -> MergedManifest | None:
    found = run.manifest() if run.file(MANIFEST).exists() else None
    return found if isinstance(found, MergedManifest) else None


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
        rows = merge_runs(runs, folder, failures)
    return MergedRuns(folder.path, tuple(sorted(runs)), failures, rows)
