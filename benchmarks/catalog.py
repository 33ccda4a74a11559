"""Open a catalog of 100,000 synthetic runs from its index, and group a million approaches.

    python benchmarks/catalog.py [--runs 100000] [--approaches 10]

The manifests are small and synthetic, without tables. The peer of the grouping is plain pyarrow:
the same columns of the same rows, read from a Parquet file and grouped. Times are CPU seconds of
this process (all threads) and wall seconds, the best of three.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import chain
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import crosscue

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support.catalog_runs import approach_row, scene
from support.manifests import estimated

SQL = (
    "select approach, count(*) as n, avg(detected_range_m) as mean_m "
    "from approaches group by approach"
)


def main() -> None:
    """Write the synthetic runs, and time indexing, opening and grouping."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--approaches", type=int, default=10, help="of each run")
    args = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="catalog-"))
    try:
        _make(folder / "runs", args.runs, args.approaches)
        _measure(folder)
    finally:
        shutil.rmtree(folder)


def _make(folder: Path, runs: int, approaches: int) -> None:
    seen_there = scene(*(approach_row(number, 20.125) for number in range(approaches)))
    manifest = estimated(scene=seen_there).model_dump_json(by_alias=True)
    parts = manifest.split("20.125")
    ranges_m = np.random.default_rng(0).uniform(5.0, 80.0, (runs, approaches))
    for number in range(runs):
        run = folder / f"{number % 100:02}" / f"drive-{number:06}"
        run.mkdir(parents=True)
        drawn = [*map(repr, ranges_m[number].tolist()), ""]
        text = "".join(chain.from_iterable(zip(parts, drawn, strict=True)))
        (run / "manifest.json").write_text(text)
    print(f"made      {runs:,} runs of {approaches} approaches, {len(manifest):,} bytes each")


def _measure(folder: Path) -> None:
    runs = folder / "runs"
    _print("index", _timed(lambda: crosscue.catalog(runs), 1))
    size = (runs / ".catalog").stat().st_size
    print(f"          {size / 1e6:.1f} MB")
    _print("open", _timed(lambda: crosscue.catalog(runs)))
    found = crosscue.catalog(runs)
    _print("runs", _timed(lambda: found.query("select vehicle, count(*) from runs group by 1")))
    ours = _timed(lambda: found.query(SQL))
    _print("group by", ours)
    plain = folder / "approaches.parquet"
    pq.write_table(found.query("from approaches"), plain, compression="zstd")
    peer = _timed(lambda: _grouped(plain))
    _print("pyarrow", peer)
    print(f"ratio     {ours[0] / peer[0]:.2f} (CPU, ours to pyarrow's)")


def _grouped(path: Path) -> pa.Table:
    table = pq.read_table(path, columns=["approach", "detected_range_m"])
    return table.group_by("approach").aggregate([([], "count_all"), ("detected_range_m", "mean")])


def _timed(work: Callable[[], object], times: int = 3) -> tuple[float, float]:
    """Return the lowest CPU and wall seconds of several calls."""
    found = []
    for _ in range(times):
        cpu, wall = time.process_time(), time.perf_counter()
        work()
        found.append((time.process_time() - cpu, time.perf_counter() - wall))
    return min(found)


def _print(what: str, seconds: tuple[float, float]) -> None:
    print(f"{what:9} {seconds[0]:.2f} s CPU, {seconds[1]:.2f} s wall")


if __name__ == "__main__":
    main()
