"""Divide the table of a study's drives by case."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pyarrow as pa


def split(table: pa.Table) -> Iterator[dict[str, NDArray[np.float64]]]:
    """Yield the columns of each case, by name."""
    cases = table["case"].to_numpy()
    columns = {name: table[name].to_numpy() for name in table.column_names if name != "case"}
    for case in range(int(cases[-1]) + 1):
        part = slice(*np.searchsorted(cases, [case, case + 1]).tolist())
        yield {name: column[part] for name, column in columns.items()}
