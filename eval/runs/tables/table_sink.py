"""A table of a run, written a batch at a time."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self

from crosscue.eval.runs.folder import RunFolder
from crosscue.replay.base import cannot_write
from crosscue.replay.files.partial_file import PartialFile

if TYPE_CHECKING:
    import pyarrow as pa

GROUP_ROWS: Final = 8192
"""Rows of a table held back before they are written."""


class TableSink:
    """A Parquet file written a batch at a time and named when whole; a context manager.

    Small batches are held back until they make a row group worth its header.
    """

    def __init__(self, run: RunFolder, name: str, schema: pa.Schema) -> None:
        """Begin ``NAME.parquet``."""
        import pyarrow.parquet as pq

        self._path: Final = run.file(f"{name}.parquet")
        self._schema: Final = schema
        self._held: list[pa.Table] = []
        self._rows = 0
        try:
            self._partial: Final = PartialFile(self._path)
            self._file: Final = self._partial.open()
        except OSError as error:
            raise cannot_write(self._path, error) from None
        try:
            self._writer: Final = pq.ParquetWriter(
                self._file, schema, compression="zstd", write_page_checksum=True
            )
        except OSError as error:
            self._give_up()
            raise cannot_write(self._path, error) from None

    def write(self, columns: Mapping[str, object]) -> None:
        """Append rows given as columns.

        Raises:
            OutputError: The disk is full.
        """
        import pyarrow as pa

        table = pa.table(dict(columns), schema=self._schema)
        self._held.append(table)
        self._rows += table.num_rows
        if self._rows < GROUP_ROWS:
            return
        try:
            self._flush()
        except OSError as error:
            raise cannot_write(self._path, error) from None

    def _flush(self) -> None:
        import pyarrow as pa

        held, self._held, self._rows = self._held, [], 0
        if held:
            self._writer.write_table(pa.concat_tables(held).combine_chunks())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None:
            # The disk may be full: what matters is that nothing half stays and the cause is kept.
            with suppress(OSError, ValueError):
                self._writer.close()
            self._give_up()
            return
        try:
            self._flush()
            self._writer.close()
            self._file.close()
            self._partial.keep()
        except OSError as error:
            self._give_up()
            raise cannot_write(self._path, error) from None

    def _give_up(self) -> None:
        """Leave nothing half."""
        with suppress(OSError):
            self._file.close()
        self._partial.drop()
