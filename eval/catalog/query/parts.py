"""Tables stored in the runs: one data set over the Parquet files of all runs.

Arrow reads only the needed columns and row groups and verifies page checksums. The run is a
partition column with one value per file, so the files of other runs are not opened.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crosscue.eval.runs.tables.columns import QUERIED, RUN, arrow_schema
from crosscue.replay.files import door

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.dataset as ds
    import pyarrow.fs

WORKERS: Final = 8
SCORE: Final = "score/"
# Path of a table in a run, if it is not stored under its own name.
FILES: Final[Mapping[str, str]] = {
    "scores": "score/by_drive.parquet",
    "cue_frames": "score/cue_frames.parquet",
    "curves": "score/curves.parquet",
}
# SQL of the tables that are computed from a file.
VIEWS: Final[Mapping[str, str]] = {
    "scores": "select run, log, metric, kind, total, rows, places, case kind when 'sum' then total "
    "when 'rms' then sqrt(total / nullif(rows, 0)) else total / nullif(rows, 0) end as value "
    "from {table}",
}


def file_of(table: str) -> str:
    """Return the path of a table in a run."""
    return FILES.get(table, f"{table}.parquet")


def table_names(files: Iterable[str]) -> set[str]:
    """Return the names of the tables that these files contain."""
    inside = {name: table for table, name in FILES.items()}
    plain = {name.removesuffix(".parquet") for name in files if not name.startswith(SCORE)}
    return plain | {inside[name] for name in files if name in inside}


class RunsTable:
    """One table over many runs.

    Attributes:
        left_out: Reason why a run's file could not be read, by run.
    """

    def __init__(
        self, table: str, runs: Mapping[str, str], filesystem: pyarrow.fs.FileSystem
    ) -> None:
        """Read the schema of every file.

        Args:
            table: Name of the table.
            runs: Path of each run's file in the file system, by run.
            filesystem: File system of the runs.
        """
        import pyarrow as pa
        import pyarrow.dataset as ds

        self.left_out: Final[dict[str, str]] = {}
        self._places: Final = runs
        self._filesystem: Final = filesystem
        scan = ds.ParquetFragmentScanOptions(pre_buffer=True, page_checksum_verification=True)
        self._form: Final = ds.ParquetFileFormat(default_fragment_scan_options=scan)
        self._fragments: Final[dict[str, ds.Fragment]] = {}
        schema = arrow_schema(RUN)
        for run, fragment, found in _opened(runs, filesystem, self._form):
            try:
                if isinstance(found, Exception):
                    raise found
                schema = pa.unify_schemas([schema, found], promote_options="permissive")
            except (OSError, pa.ArrowException) as error:
                self.left_out[run] = _why(runs[run], error)
                continue
            self._fragments[run] = fragment
        self._schema: Final = schema if self._fragments else arrow_schema(QUERIED.get(table, RUN))

    @property
    def dataset(self) -> ds.Dataset:
        """Rows of all runs whose file can be read."""
        import pyarrow.dataset as ds

        fragments = list(self._fragments.values())
        return ds.FileSystemDataset(fragments, self._schema, self._form, self._filesystem)

    def drop_damaged(self) -> int:
        """Read every file completely, leave out unreadable ones, and return their number."""
        import pyarrow as pa

        damaged = {}
        for run, fragment in self._fragments.items():
            try:
                for _ in fragment.to_batches():
                    pass
            except (OSError, pa.ArrowException) as error:
                damaged[run] = _why(self._places[run], error)
        for run in damaged:
            del self._fragments[run]
        self.left_out.update(damaged)
        return len(damaged)


def _opened(
    runs: Mapping[str, str], filesystem: pyarrow.fs.FileSystem, form: ds.ParquetFileFormat
) -> Iterator[tuple[str, ds.Fragment, pa.Schema | Exception]]:
    import pyarrow as pa
    import pyarrow.dataset as ds

    def schema_of(fragment: ds.Fragment) -> pa.Schema | Exception:
        try:
            return fragment.physical_schema.remove_metadata()
        except (OSError, pa.ArrowException) as error:
            return error

    def fragment_of(run: str, path: str) -> ds.Fragment:
        is_run = ds.field("run") == run
        try:
            return form.make_fragment(path, filesystem, partition_expression=is_run)
        except UnicodeEncodeError:
            # Arrow's file systems refuse a name that is not UTF-8. This file stays open.
            file = door.arrow_file(Path(path))
            return form.make_fragment(file, partition_expression=is_run)

    fragments = [fragment_of(run, path) for run, path in runs.items()]
    with ThreadPoolExecutor(WORKERS) as pool:
        yield from zip(runs, fragments, pool.map(schema_of, fragments), strict=True)


def _why(path: str, error: Exception) -> str:
    name = path.rpartition("/")[2]
    if isinstance(error, FileNotFoundError):
        return f"{name}: deleted; open the catalog again"
    return f"{name}: damaged or of other types ({' '.join(str(error).split())[:200]}); replay again"
