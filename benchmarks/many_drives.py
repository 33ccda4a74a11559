"""Many drives: overhead of the engine, cost of a drive hour, and merging.

    python benchmarks/many_drives.py [--rounds 5] [--tiny 204] [--drives 4] [--minutes 1.5]

The first part uses tiny drives (a run folder with eight small tables each) to measure the engine
and merging: a plain loop, our engines with their journal, with and without merging, and
``concurrent.futures`` as the peer, alternating. The second part is ``crosscue replay`` of simulated
town drives with a camera and cached detections, with one worker and with two. The third part is the
merging of tables, next to reading all of them and writing one.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import estimate  # type: ignore[import-not-found]  # next to this script
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from crosscue.datasets.simulated.drive import DriveSettings, vehicle_text
from crosscue.eval import cli
from crosscue.eval.batch.jobs import Job, in_turn, run_many
from crosscue.eval.batch.merge import gathered, merge_runs
from crosscue.eval.batch.ray_jobs import Processes
from crosscue.eval.runs.folder import RunFolder, clear, create, locked, open_run, write_manifest
from crosscue.eval.runs.tables.parquet import TableSink

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from support.manifests import estimated

SCHEMA = pa.schema([("t_ns", pa.int64())])
TABLES = ("pose", "belief", "range", "cues", "detections", "road", "frames", "skipped")
DETECTOR = """
[detectors.busy]
kind = "estimate:build"
"""


@dataclass(frozen=True, slots=True)
class Written:
    """Result of the minimal work that the engine requires."""

    exit_status: int = 0


def tiny(job: Job) -> Written:
    """Write a minimal run."""
    run = create(job.run, overwrite=True)
    with locked(run):
        clear(run)
        for name in TABLES:
            with TableSink(run, name, SCHEMA) as sink:
                sink.write({"t_ns": np.arange(1000)})
        write_manifest(run, estimated())
    return Written()


def tiny_jobs(folder: Path, count: int) -> list[Job]:
    log = folder / "log"
    log.touch()
    shutil.rmtree(folder / "runs", ignore_errors=True)
    return [
        Job(f"drive{i}", (str(log),), folder / "runs" / f"drive{i}", "same") for i in range(count)
    ]


def loop(jobs: Sequence[Job]) -> None:
    for job in jobs:
        tiny(job)


def merged(jobs: Sequence[Job]) -> None:
    """Run and merge the drives as ``replay`` of many drives does."""
    run_many(jobs, tiny, Processes(1))
    runs, failures = gathered([jobs[0].run.parent])
    merge_runs(runs, create(jobs[0].run.parent.parent / "merged", overwrite=True), failures)


def peer(workers: int) -> Callable[[Sequence[Job]], None]:
    def work(jobs: Sequence[Job]) -> None:
        fresh = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, mp_context=fresh) as pool:
            list(pool.map(tiny, jobs))

    return work


def engines(folder: Path, rounds: int, drives: int) -> None:
    few, many = 4, drives
    ways: dict[str, Callable[[Sequence[Job]], object]] = {
        "plain loop": loop,
        "ours, in turn": lambda jobs: run_many(jobs, tiny, in_turn),
        "ours, 1 process": lambda jobs: run_many(jobs, tiny, Processes(1)),
        "ours, 1, and merged": merged,
        "ours, 2 processes": lambda jobs: run_many(jobs, tiny, Processes(2)),
        "concurrent.futures, 1": peer(1),
        "concurrent.futures, 2": peer(2),
    }
    spent: dict[tuple[str, int], list[float]] = {(way, n): [] for way in ways for n in (few, many)}
    used: dict[tuple[str, int], list[float]] = {place: [] for place in spent}
    for _ in range(rounds):
        for way, work in ways.items():
            for n in (few, many):
                jobs = tiny_jobs(folder, n)
                began, began_cpu = time.perf_counter(), cpu_s()
                work(jobs)
                spent[way, n].append(time.perf_counter() - began)
                used[way, n].append(cpu_s() - began_cpu)
    base = (median(spent["plain loop", many]) - median(spent["plain loop", few])) / (many - few)
    bare = (median(used["plain loop", many]) - median(used["plain loop", few])) / (many - few)
    print(f"tiny drives: to begin, and for each of {many - few} more\n")
    print("engine                  begin s   ms/drive   of plain loop   CPU ms/drive   overhead")
    for way in ways:
        begin, whole = median(spent[way, few]), median(spent[way, many])
        each = (whole - begin) / (many - few)
        cpu = (median(used[way, many]) - median(used[way, few])) / (many - few)
        print(
            f"{way:22} {begin:8.2f} {each * 1e3:10.2f} {each / base:15.2f} {cpu * 1e3:14.2f} "
            f"{(cpu - bare) * 1e3:10.2f}"
        )
    jobs = tiny_jobs(folder, many)
    run_many(jobs, tiny, in_turn)
    began = time.perf_counter()
    run_many(jobs, tiny, in_turn)
    seen = time.perf_counter() - began
    print(f"\na second start checks {many} done drives in {seen * 1e3:.0f} ms")


def town_drives(folder: Path, count: int, minutes: float) -> float:
    """Write drive folders and return the total seconds of their logs."""
    dbc = Path(__file__).parent.parent / "datasets" / "simulated" / "simulated_car.dbc"
    seconds = 0.0
    for seed in range(count):
        blocks = max(4, round(minutes * 60.0 / estimate.SECONDS_PER_BLOCK))
        settings = DriveSettings(seed=seed, blocks=blocks)
        drive = folder / f"drive{seed}"
        drive.mkdir(parents=True)
        seconds += estimate.write_log(drive / "drive.mcap", settings)
        text = vehicle_text(settings, str(dbc)) + estimate.RANGES + DETECTOR
        (drive / "vehicle.toml").write_text(text)
    return seconds


def cpu_s() -> float:
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    used = [resource.getrusage(kind) for kind in kinds]
    return sum(one.ru_utime + one.ru_stime for one in used)


def drive_hours(folder: Path, seconds: float, rounds: int) -> None:
    runs = folder / "runs"

    def replay(workers: int) -> tuple[float, float]:
        shutil.rmtree(runs, ignore_errors=True)
        argv = [
            "replay",
            str(folder / "drives"),
            "-o",
            str(runs),
            "--workers",
            str(workers),
            "-q",
            "--cache",
            str(folder / "cache.sqlite"),
        ]
        began, began_cpu = time.perf_counter(), cpu_s()
        assert cli.run(argv) == 0
        return time.perf_counter() - began, cpu_s() - began_cpu

    replay(1)
    spent: dict[int, list[tuple[float, float]]] = {1: [], 2: []}
    for _ in range(rounds):
        for workers, taken in spent.items():
            taken.append(replay(workers))
    size = sum(path.stat().st_size for path in folder.glob("drives/*/drive.mcap"))
    print(f"\ntown drives from cached detections: {seconds / 60:.1f} min, {size / 1e6:.0f} MB\n")
    print("workers   wall s   CPU s   wall s a drive hour   CPU s a drive hour   times real time")
    for workers, taken in spent.items():
        wall, cpu = median(one[0] for one in taken), median(one[1] for one in taken)
        hours = seconds / 3600.0
        print(
            f"{workers:7} {wall:8.2f} {cpu:7.2f} {wall / hours:21.1f} {cpu / hours:20.1f}"
            f" {seconds / wall:17.0f}"
        )
    one, two = (median(wall for wall, _ in spent[workers]) for workers in (1, 2))
    print(f"\ntwo workers take {two / one:.2f} of one worker's time")
    held = sum(path.stat().st_size for path in runs.rglob("*.parquet")) / 2
    print(f"tables: {held / seconds * 3600 / 1e6:.0f} MB a drive hour")


def merging(folder: Path, rounds: int) -> None:
    runs = {
        path.name: open_run(path)
        for path in sorted((folder / "runs").iterdir())
        if path.name not in ("merged", ".drives")
    }
    kinds = sorted({path.stem for run in runs.values() for path in run.path.glob("*.parquet")})
    out = create(folder / "out", overwrite=True)

    def ours(of: dict[str, RunFolder]) -> None:
        merge_runs(of, out, {})

    def whole(of: dict[str, RunFolder]) -> None:
        for kind in kinds:
            tables = [_with_name(run.table(kind), name) for name, run in of.items()]
            pq.write_table(
                pa.concat_tables(tables),
                out.path / f"{kind}.parquet",
                compression="zstd",
                write_page_checksum=True,
            )

    taken: dict[str, list[float]] = {"ours, streamed": [], "read all, write one": []}
    for _ in range(rounds):
        for way, work in zip(taken, (ours, whole), strict=True):
            began = time.perf_counter()
            work(runs)
            taken[way].append(time.perf_counter() - began)
    rows = sum(out_rows(runs.values(), kind) for kind in kinds)
    peer_s = median(taken["read all, write one"])
    print(f"\nmerging {len(runs)} runs, {rows:,} rows of {len(kinds)} tables\n")
    print("way                      s    rows/s   of peer")
    for way, seconds in taken.items():
        print(
            f"{way:20} {median(seconds):6.3f} {rows / median(seconds):9,.0f}"
            f" {median(seconds) / peer_s:9.2f}"
        )
    print("\npeak of Arrow's memory while merging, MB, by number of drives")
    for times in (1, 4, 16):
        more = {f"{name}-{i}": run for i in range(times) for name, run in runs.items()}
        peaks = [_peak_mb(work, more) for work in (ours, whole)]
        print(f"{len(more):5} drives: ours {peaks[0]:6.1f}, read all {peaks[1]:6.1f}")


def out_rows(runs: Iterable[RunFolder], kind: str) -> int:
    return sum(pq.read_metadata(run.file(f"{kind}.parquet")).num_rows for run in runs)


def _with_name(table: pa.Table, name: str) -> pa.Table:
    return table.add_column(0, "drive", pa.repeat(pa.scalar(name), table.num_rows))


def _peak_mb(work: Callable[[dict[str, RunFolder]], None], runs: dict[str, RunFolder]) -> float:
    """Measure in a new process, because the peak of a memory pool cannot be reset."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        before = pa.default_memory_pool().bytes_allocated()
        pool = pa.system_memory_pool()
        pa.set_memory_pool(pool)
        work(runs)
        os.write(write, str(pool.max_memory() - before).encode())
        os._exit(0)
    os.waitpid(child, 0)
    peak = int(os.read(read, 64)) / 1e6
    os.close(read)
    os.close(write)
    return peak


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--drives", type=int, default=4)
    parser.add_argument("--tiny", type=int, default=204)
    parser.add_argument("--minutes", type=float, default=1.5)
    args = parser.parse_args()
    with TemporaryDirectory() as name:
        folder = Path(name)
        engines(folder, args.rounds, args.tiny)
        if args.drives == 0:
            return
        seconds = town_drives(folder / "drives", args.drives, args.minutes)
        drive_hours(folder, seconds, args.rounds)
        merging(folder, args.rounds)


if __name__ == "__main__":
    # Worker processes cannot import functions of ``__main__``.
    import_module("many_drives").main()
