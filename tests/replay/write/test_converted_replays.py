"""A converted log has the same roles as its original, and replays to the same tables."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest

from crosscue.eval import cli
from support.data import shared


def convert(log: Path, out: Path) -> Path:
    assert cli.run(["convert", str(log), "-o", str(out)]) in (0, 3)
    return out


def _tables(log: Path, run: Path) -> dict[str, object]:
    assert cli.run(["replay", str(log), "-o", str(run)]) in (0, 3)
    names = ("pose", "measurements")
    return {name: pq.read_table(run / f"{name}.parquet").to_pydict() for name in names}


@pytest.mark.slow
def test_converted_real_segment_replays_like_original(tmp_path: Path) -> None:
    (log,) = shared("comma2k19/Example_1").glob("*/40")

    assert _tables(convert(log, tmp_path / "log.mcap"), tmp_path / "b") == _tables(
        log, tmp_path / "a"
    )
