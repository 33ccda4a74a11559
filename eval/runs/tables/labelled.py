"""The two columns that every table of a run has: ``segment`` and ``log_t_ns``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from crosscue.replay.time.segments import LogClock, Timeline

from .parquet import TableFolder, TableSink, arrow_column

if TYPE_CHECKING:
    import pyarrow as pa


def labelled(schema: pa.Schema) -> pa.Schema:
    """Return a table's schema with the two columns appended."""
    import pyarrow as pa

    return schema.append(pa.field("segment", pa.int32())).append(pa.field("log_t_ns", pa.int64()))


def with_labels(table: pa.Table, timeline: Timeline, clock: LogClock) -> pa.Table:
    """Return a table in memory with the two columns appended."""
    import pyarrow as pa

    times = table["t_ns"].to_numpy()
    numbers = arrow_column(timeline.numbers(times), pa.int32())
    original = arrow_column(clock.log_times(times), pa.int64())
    return table.append_column("segment", numbers).append_column("log_t_ns", original)


class LabelledSink(TableSink):
    """A table of a run; each row's segment and original stamp are added by its ``t_ns``."""

    def __init__(
        self, run: TableFolder, name: str, schema: pa.Schema, timeline: Timeline, clock: LogClock
    ) -> None:
        """Create ``NAME.parquet``; ``clock`` is that of the log that the rows come from."""
        super().__init__(run, name, labelled(schema))
        self._timeline = timeline
        self._clock = clock

    def write(self, columns: Mapping[str, object]) -> None:
        """Append rows, as columns without the two.

        Raises:
            OutputError: The disk is full.
        """
        times = np.asarray(columns["t_ns"], np.int64)
        numbers = self._timeline.numbers(times)
        original = self._clock.log_times(times)
        super().write({**columns, "segment": numbers, "log_t_ns": original})
