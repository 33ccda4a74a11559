"""Simulate thousands of drives on many cores, in chunks.

Chunks are written in order, so the result has the same bytes on any number of workers.
"""

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.tables.columns import REAL, SMALL, TEXT, Column, arrow_schema
from crosscue.eval.runs.tables.parquet import TableSink
from crosscue.localization.town.drive import DriveResult, Keys, drive_many
from crosscue.localization.town.random_stream import key_of
from crosscue.localization.town.settings import TownDrive
from crosscue.replay.columns import Floats
from crosscue.replay.errors import UsageError, WorkerError

from .settings import Case

CHUNK_DRIVES: Final = 100
DRIVES: Final = "drives"
# Columns of ``drives.parquet``: the conditions of a drive, then its ``DriveResult``.
CONDITIONS: Final = {
    "case": Column(SMALL, "index of the case"),
    "drive": Column(SMALL, "number of the drive in its case"),
    "seed": Column("UBIGINT", "seed of the drive"),
    "compass_2sigma_deg": Column(REAL, "two standard deviations of the compass"),
    "strategy": Column(TEXT, "how the car chooses its way"),
    "landmarks_per_km2": Column(REAL, "density of landmarks"),
    "detection_rate": Column(REAL, "fraction of landmarks that are detected"),
}
RESULTS: Final = dict.fromkeys(DriveResult._fields, Column(REAL, "see DriveResult"))


@dataclass(frozen=True, slots=True)
class DriveBatch:
    """Some drives of one case.

    Attributes:
        case: Index of the case.
        settings: Settings of each drive.
        block: Block of the case.
        first: Number of the first drive.
        count: Number of drives.
        study_seed: Seed of the study.
    """

    case: int
    settings: TownDrive
    block: int
    first: int
    count: int
    study_seed: int

    def seeds(self) -> Keys:
        """Seeds, shape (count,), which depend only on study seed, block and number of the drive."""
        numbers = range(self.first, self.first + self.count)
        return np.array([key_of(self.study_seed, self.block, i) for i in numbers], np.uint64)


def chunks_of(cases: Sequence[Case], drives: int, study_seed: int) -> list[DriveBatch]:
    """Return all chunks, in the order of the result."""
    return [
        DriveBatch(
            i, case.settings, case.block, first, min(CHUNK_DRIVES, drives - first), study_seed
        )
        for i, case in enumerate(cases)
        for first in range(0, drives, CHUNK_DRIVES)
    ]


def workers_of(workers: int | None) -> int:
    """Return the number of workers, by default one for each core that this process may use.

    Raises:
        UsageError: The number is below 1.
    """
    if workers is not None and workers < 1:
        raise UsageError(f"workers: {workers}, expected 1 or more")
    return workers or len(os.sched_getaffinity(0))


def run(
    chunks: Sequence[DriveBatch],
    folder: Path,
    workers: int,
    drive: Callable[[TownDrive, Keys], Floats] = drive_many,
) -> Iterator[int]:
    """Simulate all chunks into ``drives.parquet``, and yield the number of finished chunks.

    Args:
        chunks: Chunks from ``chunks_of``.
        folder: Folder of the study.
        workers: Number of threads.
        drive: Function that simulates drives.

    Raises:
        WorkerError: A worker ran out of memory.
        OutputError: The disk is full.
    """
    waiting, running = deque(chunks), deque[tuple[DriveBatch, Future[Floats]]]()
    pool = ThreadPoolExecutor(workers)
    try:
        with TableSink(RunFolder(folder), DRIVES, arrow_schema({**CONDITIONS, **RESULTS})) as sink:
            for done in range(1, len(chunks) + 1):
                while waiting and len(running) < 2 * workers:
                    chunk = waiting.popleft()
                    running.append((chunk, pool.submit(drive, chunk.settings, chunk.seeds())))
                chunk, future = running.popleft()
                sink.write(_with_conditions(chunk, _result(future)))
                yield done
    finally:
        pool.shutdown(cancel_futures=True)


def split(table: pa.Table) -> Iterator[dict[str, Floats]]:
    """Yield the columns of each case, by name."""
    cases = table["case"].to_numpy()
    columns = {name: table[name].to_numpy() for name in table.column_names if name != "case"}
    for case in range(int(cases[-1]) + 1):
        part = slice(*np.searchsorted(cases, [case, case + 1]).tolist())
        yield {name: column[part] for name, column in columns.items()}


def _with_conditions(chunk: DriveBatch, rows: Floats) -> dict[str, object]:
    n, settings = chunk.count, chunk.settings
    return {
        "case": [chunk.case] * n,
        "drive": list(range(chunk.first, chunk.first + n)),
        "seed": chunk.seeds(),
        "compass_2sigma_deg": [settings.sensors.compass_2sigma_deg] * n,
        "strategy": [settings.navigation.strategy] * n,
        "landmarks_per_km2": [settings.landmarks_per_km2] * n,
        "detection_rate": [settings.sensors.detection_rate] * n,
        **dict(zip(DriveResult._fields, rows.T, strict=True)),
    }


def _result(future: Future[Floats]) -> Floats:
    try:
        return future.result()
    except ValueError as error:
        raise UsageError(f"study: {error}; change the drive's city") from None
    except MemoryError as error:
        raise WorkerError(f"study: a worker ran out of memory ({error}); run it again") from None
