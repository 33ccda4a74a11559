"""A recording of a part of a run contains exactly that part."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rerun.chunk import RrdReader

import crosscue
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.moments import run_between
from crosscue.replay.errors import UsageError
from support.refusals import refusal
from support.scene_run import scene_run
from support.scoring import at


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return scene_run(tmp_path_factory.mktemp("part"))


def test_tables_of_a_part_have_only_its_rows_and_selected_columns(run: RunFolder) -> None:
    part = run_between(run, at(10), at(19))

    assert part.table("frames")["t_ns"].to_pylist() == [at(frame) for frame in range(10, 20)]
    assert part.table("frames", ["frame"]).column_names == ["frame"]
    assert sum(len(batch) for batch in part.batches("detections", ["label"])) == 2 * 10


def test_moment_in_nanoseconds_yields_the_same_recording(run: RunFolder, tmp_path: Path) -> None:
    rows = [
        sum(
            chunk.num_rows
            for chunk in RrdReader(
                crosscue.save_recording(run.path, tmp_path / name, at=moment)
            ).stream()
        )
        for name, moment in (("a.rrd", 3.0), ("b.rrd", f"{at(30)}ns"))
    ]

    assert rows[0] == rows[1]


def test_approach_is_recorded_from_its_first_step_to_its_last(tmp_path: Path) -> None:
    run = scene_run(tmp_path / "drive")
    belief = run.table("belief")
    column = belief.schema.get_field_index("approach")
    numbers = [7 if 10 <= frame < 30 else None for frame in range(len(belief))]
    numbers = pa.array(numbers, belief.schema.field("approach").type)
    pq.write_table(belief.set_column(column, "approach", numbers), run.file("belief.parquet"))

    path = crosscue.save_recording(run.path, tmp_path / "a.rrd", approach=7, only=("belief",))

    times: set[int] = set()
    for chunk in RrdReader(path).stream():
        if not chunk.is_static:
            times.update(chunk.to_record_batch().column("drive").cast("int64").to_pylist())
    assert times == {at(frame) for frame in range(10, 30)}
    with pytest.raises(UsageError, match="it has: 7"):
        crosscue.save_recording(run.path, tmp_path / "none.rrd", approach=8)


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        ("--at 99", "lasts from 0 to 4.9"),
        ("--at noon", "expected seconds"),
        ("--at nan", "expected seconds"),
        ("--at 1 --approach 7", "not allowed"),
        ("--only sky", "expected some of cameras"),
    ],
)
def test_invalid_part_options_are_refused_in_one_line(
    run: RunFolder, tmp_path: Path, flags: str, named: str
) -> None:
    output = tmp_path / "x.rrd"

    assert named in refusal(2, "view", run.path, "-o", output, *flags.split())
    assert not output.exists()
