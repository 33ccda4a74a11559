"""The index of a catalog as one file: a zip of Parquet tables, replaced whole.

It only saves time: whatever is wrong with it, the runs are read again. Its members are stored, not
compressed again, and zip's checksums show damage.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from crosscue.replay.base import one_line, write_bytes

if TYPE_CHECKING:
    import pyarrow as pa

FORMAT: Final = "format"


class Stored:
    """An index that was read; its tables are opened when they are used."""

    def __init__(self, content: bytes, mark: str) -> None:
        """Check the head.

        Args:
            content: Of the file.
            mark: What this version writes.

        Raises:
            ValueError: Damaged, or of another version.
        """
        try:
            self._archive: Final = zipfile.ZipFile(io.BytesIO(content))
            written = self._archive.read(FORMAT)
        except (zipfile.BadZipFile, KeyError, OSError) as error:
            raise ValueError(f"damaged ({one_line(error)})") from None
        if written != mark.encode():
            raise ValueError("of another version")

    def table(self, name: str) -> Any:
        """One of its tables: a data set, of which only the columns that are used get decoded.

        Raises:
            ValueError: Damaged.
        """
        import pyarrow as pa
        import pyarrow.dataset as ds

        form = ds.ParquetFileFormat()
        try:
            fragment = form.make_fragment(pa.py_buffer(self._archive.read(name)))
            return ds.FileSystemDataset([fragment], fragment.physical_schema, form)
        except (zipfile.BadZipFile, KeyError, OSError, pa.ArrowException) as error:
            raise ValueError(f"damaged ({one_line(error)})") from None


def write(path: Path, mark: str, tables: Mapping[str, pa.Table]) -> None:
    """Write an index, whole or not at all.

    Raises:
        OutputError: It cannot be written.
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
