"""File format of a catalog's index: a zip of Parquet tables that is replaced atomically.

The index is only a cache: if it is damaged, the runs are read again. Its members are stored without
further compression, and the checksums of zip reveal damage.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from crosscue.replay.errors import one_line
from crosscue.replay.files.whole_file import write_bytes

if TYPE_CHECKING:
    import pyarrow as pa

FORMAT: Final = "format"


class StoredIndex:
    """An index in memory; its tables are opened when they are used."""

    def __init__(self, content: bytes, mark: str) -> None:
        """Check the version.

        Args:
            content: Content of the file.
            mark: Version that this crosscue writes.

        Raises:
            ValueError: The file is damaged or of another version.
        """
        try:
            self._archive: Final = zipfile.ZipFile(io.BytesIO(content))
            written = self._archive.read(FORMAT)
        except (zipfile.BadZipFile, KeyError, OSError) as error:
            raise ValueError(f"damaged ({one_line(error)})") from None
        if written != mark.encode():
            raise ValueError("of another version")

    def table(self, name: str) -> Any:
        """Return one of its tables as a data set, which decodes only the columns that are used.

        Raises:
            ValueError: The table is damaged.
        """
        import pyarrow as pa
        import pyarrow.dataset as ds

        form = ds.ParquetFileFormat()
        try:
            fragment = form.make_fragment(pa.py_buffer(self._archive.read(name)))
            return ds.FileSystemDataset([fragment], fragment.physical_schema, form)
        except (zipfile.BadZipFile, KeyError, OSError, pa.ArrowException) as error:
            raise ValueError(f"damaged ({one_line(error)})") from None


def write_index(path: Path, mark: str, tables: Mapping[str, pa.Table]) -> None:
    """Write an index atomically.

    Raises:
        OutputError: The file cannot be written.
    """
    import pyarrow.parquet as pq

    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr(FORMAT, mark)
        for name, table in tables.items():
            member = io.BytesIO()
            pq.write_table(table, member, compression="zstd")
            archive.writestr(name, member.getvalue())
    write_bytes(path, content.getvalue())
