"""Tables of a folder: Parquet with page checksums, written in batches, verified when read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.errors import UnreadableRunError
from crosscue.replay.files import door
from crosscue.replay.files.partial_file import PartialFile
from crosscue.replay.files.whole_file import cannot_write

if TYPE_CHECKING:
    import pyarrow as pa

# Rows of a table buffered before they are written.
GROUP_ROWS: Final = 8192


def arrow_column(values: Any, kind: pa.DataType) -> pa.Array:
    """Return values, None where one is missing, as a column of Arrow.

    Numbers, texts and bytes are not left to ``pa.array``: where pandas is installed, it imports it,
    which takes as long as a short replay.
    """
    import pyarrow as pa

    if isinstance(values, pa.Array | pa.ChunkedArray):
        return values
    size, present, is_text = len(values), None, kind in (pa.string(), pa.binary())
    if not (is_text or pa.types.is_dictionary(kind) or pa.types.is_primitive(kind)):
        return pa.array(values, kind)
    if not isinstance(values, np.ndarray) and None in values:
        present = _bits(np.array([one is not None for one in values], np.bool_))
        values = [("" if is_text else False) if one is None else one for one in values]
    if pa.types.is_dictionary(kind):
        names = {name: number for number, name in enumerate(dict.fromkeys(values))}
        codes = np.array([names[one] for one in values], kind.index_type.to_pandas_dtype())
        texts = arrow_column([*names], kind.value_type)
        return pa.DictionaryArray.from_buffers(kind, size, [present, pa.py_buffer(codes)], texts)
    if is_text:
        coded = {one: one if isinstance(one, bytes) else str(one).encode() for one in {*values}}
        parts = [coded[one] for one in values]
        ends = np.cumsum([0, *map(len, parts)]).astype(np.int32)
        buffers = [present, pa.py_buffer(ends), pa.py_buffer(b"".join(parts))]
        return pa.Array.from_buffers(kind, size, buffers)
    numbers = np.asarray(values) if size else np.empty(0, np.bool_)
    numbers = numbers.astype(kind.to_pandas_dtype(), "C", "same_kind", copy=False)
    content = _bits(numbers) if kind == pa.bool_() else pa.py_buffer(numbers)
    return pa.Array.from_buffers(kind, size, [present, content])


def numpy_column(values: NDArray[np.generic]) -> pa.Array:
    """Return numbers or texts as a column of Arrow, which shares their memory where it can."""
    import pyarrow as pa

    if values.dtype.kind == "U":
        return arrow_column(values, pa.string())
    if values.dtype == np.bool_:
        content = _bits(values.view(np.bool_))
    else:
        content = pa.py_buffer(np.ascontiguousarray(values))
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [None, content])


def numbers_of(column: pa.Array) -> NDArray[Any]:
    """Return a column of numbers, NaN where one is missing; unlike ``to_numpy``, without pandas."""
    if column.null_count:
        return np.asarray(column.to_numpy(zero_copy_only=False))
    dtype = np.dtype(column.type.to_pandas_dtype())
    content = column.buffers()[1]
    return np.frombuffer(content, dtype, len(column), column.offset * dtype.itemsize)


def _bits(flags: NDArray[np.bool_]) -> pa.Buffer:
    import pyarrow as pa

    return pa.py_buffer(np.packbits(flags, bitorder="little"))


@dataclass(frozen=True, slots=True)
class TableFolder:
    """A folder of tables.

    Attributes:
        path: Path of the folder.
    """

    path: Path

    def file(self, name: str) -> Path:
        """Return the path of one of its files or folders.

        Raises:
            RunError: It is a link, which could lead anywhere.
        """
        try:
            return door.inside(self.path, name)
        except OSError as error:
            raise UnreadableRunError(f"{error.filename}: {error.strerror}") from None

    @contextmanager
    def _opened(self, name: str) -> Iterator[pa.NativeFile]:
        import pyarrow as pa

        path = self.file(f"{name}.parquet")
        try:
            with door.arrow_file(path) as file:
                yield file
        except FileNotFoundError:
            raise UnreadableRunError(f"{path}: not there; run crosscue replay again") from None
        except (OSError, pa.ArrowException) as error:
            raise UnreadableRunError(
                f"{path}: damaged ({error}); run crosscue replay again"
            ) from None

    def table(self, name: str, columns: list[str] | None = None) -> pa.Table:
        """Read ``NAME.parquet`` and verify its page checksums.

        Raises:
            RunError: The file is missing or damaged.
        """
        import pyarrow.parquet as pq

        # ``pq.read_table`` imports ``pyarrow.dataset``, and that pandas.
        with self._opened(name) as file:
            return pq.ParquetFile(file, page_checksum_verification=True).read(columns)

    def filled(self, name: str, columns: list[str] | None = None) -> pa.Table | None:
        """Read ``NAME.parquet`` as ``table`` does; None without the file, or without a row."""
        if not self.file(f"{name}.parquet").exists():
            return None
        found = self.table(name, columns)
        return found if found.num_rows else None

    def schema(self, name: str) -> pa.Schema:
        """Read the schema of ``NAME.parquet``.

        Raises:
            RunError: The file is missing or damaged.
        """
        import pyarrow.parquet as pq

        with self._opened(name) as file:
            return pq.read_schema(file).remove_metadata()

    def batches(
        self, name: str, columns: list[str] | None = None, rows: int = 16_384
    ) -> Iterator[pa.RecordBatch]:
        """Read ``NAME.parquet`` a batch at a time and verify its page checksums.

        Raises:
            RunError: The file is missing or damaged.
        """
        import pyarrow.parquet as pq

        with (
            self._opened(name) as handle,
            pq.ParquetFile(handle, page_checksum_verification=True) as file,
        ):
            # The lowest version of PyArrow fails on a file without rows.
            if file.num_row_groups:
                yield from file.iter_batches(rows, columns=columns, use_threads=False)


class TableSink:
    """A Parquet file written a batch at a time and renamed when complete; a context manager.

    Small batches are buffered until they form a row group of reasonable size.
    """

    def __init__(self, run: TableFolder, name: str, schema: pa.Schema) -> None:
        """Create ``NAME.parquet``."""
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
        """Append rows, as columns.

        Raises:
            OutputError: The disk is full.
        """
        import pyarrow as pa

        arrays = [arrow_column(columns[field.name], field.type) for field in self._schema]
        table = pa.table(arrays, schema=self._schema)
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

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        if kind is not None:
            # The disk may be full; remove the incomplete file and report the original error.
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
        with suppress(OSError):
            self._file.close()
        self._partial.drop()
