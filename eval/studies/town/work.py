"""Simulate thousands of drives on many cores, in chunks that are kept for later studies.

The name of a chunk is a hash of everything that its rows depend on: the compiled code, the settings
and the seeds. A chunk is written completely or not at all. The chunks of an interrupted study are
used by the next start, and by a larger study of the same conditions. Chunks are joined in order, so
the result has the same bytes on any number of workers.
"""

from __future__ import annotations

import hashlib
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.tables.columns import REAL, SMALL, TEXT, Column, arrow_schema
from crosscue.eval.runs.tables.parquet import TableSink
from crosscue.localization.town import settings as drive_settings
from crosscue.localization.town.drive import DriveResult, Keys, drive_many, drive_one
from crosscue.localization.town.random_stream import key_of
from crosscue.localization.town.settings import TownDrive
from crosscue.replay.columns import Floats
from crosscue.replay.compiled import fingerprint
from crosscue.replay.errors import RunError, UnreadableRunError, UsageError, WorkerError

from .settings import Case

if TYPE_CHECKING:
    import pyarrow as pa

CHUNK_DRIVES: Final = 100
CHUNKS: Final = "chunks"
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
DriveMany = Callable[[TownDrive, Keys], Floats]


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

    @property
    def name(self) -> str:
        """Name of its file: a hash of everything that its rows depend on."""
        parts = hashlib.sha256(_code())
        parts.update(self.settings.model_dump_json().encode())
        parts.update(self.seeds().tobytes())
        return parts.hexdigest()[:32]


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
    drive: DriveMany = drive_many,
) -> Iterator[int]:
    """Simulate the missing chunks, and yield the number of finished chunks.

    Args:
        chunks: Chunks from ``chunks_of``.
        folder: Folder of the study; finished chunks are in its folder ``chunks``.
        workers: Number of threads.
        drive: Function that simulates drives.

    Raises:
        WorkerError: A worker died; finished chunks are kept.
        OutputError: The disk is full.
    """
    kept = RunFolder(folder / CHUNKS)
    kept.path.mkdir(parents=True, exist_ok=True)
    missing = [chunk for chunk in chunks if _read(kept, chunk) is None]
    done = len(chunks) - len(missing)
    yield done
    if not missing:
        return
    for chunk, rows in _on_threads(missing, workers, drive):
        with TableSink(kept, chunk.name, arrow_schema(RESULTS)) as sink:
            sink.write(dict(zip(DriveResult._fields, rows.T, strict=True)))
        done += 1
        yield done


def assemble(chunks: Sequence[DriveBatch], folder: Path) -> None:
    """Write ``drives.parquet`` with all drives and their conditions, in order.

    Raises:
        RunError: A chunk is missing or damaged.
    """
    kept, run_folder = RunFolder(folder / CHUNKS), RunFolder(folder)
    with TableSink(run_folder, DRIVES, arrow_schema({**CONDITIONS, **RESULTS})) as sink:
        for chunk in chunks:
            rows = _read(kept, chunk)
            if rows is None:
                raise UnreadableRunError(
                    f"{kept.path}/{chunk.name}.parquet: damaged; run the study again"
                )
            sink.write(_with_conditions(chunk, rows))


def split(table: pa.Table) -> Iterator[dict[str, Floats]]:
    """Yield the columns of each case, by name."""
    cases = table["case"].to_numpy()
    columns = {name: table[name].to_numpy() for name in table.column_names if name != "case"}
    for case in range(int(cases[-1]) + 1):
        part = slice(*np.searchsorted(cases, [case, case + 1]).tolist())
        yield {name: column[part] for name, column in columns.items()}


def _with_conditions(chunk: DriveBatch, rows: dict[str, Floats]) -> dict[str, object]:
    n, settings = chunk.count, chunk.settings
    return {
        "case": [chunk.case] * n,
        "drive": list(range(chunk.first, chunk.first + n)),
        "seed": chunk.seeds(),
        "compass_2sigma_deg": [settings.sensors.compass_2sigma_deg] * n,
        "strategy": [settings.navigation.strategy] * n,
        "landmarks_per_km2": [settings.landmarks_per_km2] * n,
        "detection_rate": [settings.sensors.detection_rate] * n,
        **rows,
    }


@cache
def _code() -> bytes:
    return fingerprint(drive_one).encode() + Path(str(drive_settings.__file__)).read_bytes()


def _read(kept: RunFolder, chunk: DriveBatch) -> dict[str, Floats] | None:
    """Read a finished chunk; None if it is missing or damaged."""
    if not kept.file(f"{chunk.name}.parquet").exists():
        return None
    try:
        table = kept.table(chunk.name)
    except RunError:
        return None
    if table.num_rows != chunk.count or table.column_names != list(DriveResult._fields):
        return None
    return {name: table[name].to_numpy() for name in DriveResult._fields}


def _on_threads(
    chunks: Sequence[DriveBatch], workers: int, drive: DriveMany
) -> Iterator[tuple[DriveBatch, Floats]]:
    waiting = deque(chunks)
    pool = ThreadPoolExecutor(workers)
    running: dict[Future[Floats], DriveBatch] = {}
    try:
        while waiting or running:
            while waiting and len(running) < 2 * workers:
                chunk = waiting.popleft()
                running[pool.submit(drive, chunk.settings, chunk.seeds())] = chunk
            done = wait(running, return_when=FIRST_COMPLETED).done
            # Failures are raised last, so that chunks finished at the same time are kept.
            for future in sorted(done, key=lambda one: one.exception() is not None):
                yield running.pop(future), _result(future.result)
    finally:
        pool.shutdown(cancel_futures=True)


def _result(get: Callable[[], Floats]) -> Floats:
    try:
        return get()
    except ValueError as error:
        raise UsageError(f"study: {error}; change [drive.city] in the study file") from None
    except MemoryError as error:
        raise WorkerError(
            f"study: a worker ran out of memory ({error}); finished chunks are kept: run again"
        ) from None
