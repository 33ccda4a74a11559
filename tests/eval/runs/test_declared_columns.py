"""Laws of the columns: declared once, and every file has what is declared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import crosscue
from crosscue.detectors.box_detector import ScoredBox
from crosscue.eval.runs.tables.columns import (
    INDEXED,
    LOG_TIME,
    OF_RUN,
    OF_SCORE,
    QUERIED,
    Column,
    arrow_schema,
)
from crosscue.replay.signals.kinds import LANE_COLUMNS, OBSTACLE_COLUMNS
from support.scenes import shorten

TABLES = [*INDEXED.items(), *OF_RUN.items(), *OF_SCORE.items(), *QUERIED.items()]


@pytest.mark.parametrize(("name", "columns"), TABLES)
def test_every_column_has_a_type_and_a_meaning(name: str, columns: Mapping[str, Column]) -> None:
    assert arrow_schema(columns).names == [*columns]
    for column in columns.values():
        assert column.meaning.strip(), name


def test_streams_of_the_device_have_the_columns_that_are_decoded() -> None:
    assert [*OF_RUN["mobileye_obstacles"]] == ["t_ns", *OBSTACLE_COLUMNS]
    assert [*OF_RUN["mobileye_lanes"]] == ["t_ns", *LANE_COLUMNS]


def test_column_not_null_refuses_a_missing_value() -> None:
    schema = arrow_schema({"a": Column("BIGINT NOT NULL", ""), "b": Column("BIGINT", "")})

    assert [one.nullable for one in schema] == [False, True]


class Whole(crosscue.BoxDetector):
    """One box around the whole picture."""

    name, labels = "whole", ("stop sign",)

    def boxes_in(self, frame: crosscue.Frame) -> Iterator[ScoredBox]:
        """Return the box."""
        high, wide, _ = frame.pixels.shape
        yield "stop sign", 0.9, (0.0, 0.0, wide, high)


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> dict[str, pa.Schema]:
    """Schemas of all tables of a scored run of a simulated scene."""
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch, pictures=40)
        files = crosscue.simulate_approach(folder / "scene", width_px=320)
    run = crosscue.replay_drive(files.log, folder / "run", detectors=[Whole])
    crosscue.score_run(run, files.truth, has_figures=False)
    found = (folder / "run").rglob("*.parquet")
    return {str(path.relative_to(folder / "run")): pq.read_schema(path) for path in found}


def test_files_of_a_run_and_its_score_have_the_declared_columns(
    tables: Mapping[str, pa.Schema],
) -> None:
    of_run = {f"{name}.parquet": {**one, **LOG_TIME} for name, one in OF_RUN.items()}
    declared = of_run | {f"score/{name}.parquet": one for name, one in OF_SCORE.items()}

    assert {"frames.parquet", "detections.parquet", "belief.parquet", "pose.parquet"} <= {*tables}
    for name, schema in tables.items():
        expected = arrow_schema(declared[name])
        # Only some kinds of belief have reasons why a cue was not used.
        named = [one for one in expected.names if one in schema.names or one != "not_believed"]
        assert schema.names == named, name
        assert schema.types == [expected.field(one).type for one in named], name


def test_columns_are_declared_in_one_module() -> None:
    """A log's own topics have columns that only the log knows."""
    rooms = ("replay", "detectors", "fusion", "localization", "datasets", "eval")
    root = Path(__file__).parents[3]
    files = [path for room in rooms for path in (root / room).rglob("*.py")]
    with_schema = {
        str(path.relative_to(root)) for path in files if "pa.schema(" in path.read_text()
    }

    assert with_schema == {"eval/runs/tables/columns.py", "eval/logs/log.py"}
