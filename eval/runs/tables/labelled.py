"""The two columns that every table of a run has: ``segment`` and ``log_t_ns``."""

from collections.abc import Mapping

import numpy as np
import pyarrow as pa

from crosscue.replay.time.segments import LogClock, Timeline

from .columns import LOG_TIME, OF_RUN, Columns, arrow_schema
from .parquet import TableFolder, TableSink, arrow_column


def with_labels(table: pa.Table, timeline: Timeline, clock: LogClock) -> pa.Table:
    """Return a table in memory with the two columns appended."""
    times = table["t_ns"].to_numpy()
    numbers = arrow_column(timeline.numbers(times), pa.int32())
    original = arrow_column(clock.log_times(times), pa.int64())
    return table.append_column("segment", numbers).append_column("log_t_ns", original)


class LabelledSink(TableSink):
    """A table of a run; each row's segment and original stamp are added by its ``t_ns``."""

    def __init__(
        self,
        run: TableFolder,
        name: str,
        timeline: Timeline,
        clock: LogClock,
        columns: Columns | None = None,
    ) -> None:
        """Create ``NAME.parquet``.

        Args:
            run: The run.
            name: Name of the table.
            timeline: The drive's time segments.
            clock: Clock of the log that the rows come from.
            columns: The table's columns, without the two, if they are not those of ``OF_RUN``.
        """
        own = OF_RUN[name] if columns is None else columns
        super().__init__(run, name, arrow_schema({**own, **LOG_TIME}))
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
