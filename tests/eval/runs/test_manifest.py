"""Files of a run folder: manifest, tags and what replaces them, and the columns of its tables."""

import errno
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import crosscue
from crosscue.detectors.box_detector import ScoredBox
from crosscue.eval import cli
from crosscue.eval.batch.merge import gathered, merge_runs
from crosscue.eval.runs.account import account
from crosscue.eval.runs.folder import RunFolder, create, open_run, write_manifest
from crosscue.eval.runs.manifest import FORMAT_VERSION, Manifest, TimeSegments
from crosscue.eval.runs.tables.columns import (
    INDEXED,
    LOG_TIME,
    OF_RUN,
    OF_SCORE,
    QUERIED,
    Column,
    arrow_schema,
)
from crosscue.eval.runs.tables.parquet import arrow_column
from crosscue.replay.errors import OutputError, RunError, UnreadableRunError, UsageError
from crosscue.replay.files.whole_file import write_text, write_whole
from crosscue.replay.signals.kinds import LANE_COLUMNS, OBSTACLE_COLUMNS
from crosscue.replay.time.segments import Cause, Epoch, EpochMarks, LogClock, TimeSegment
from support.catalog_runs import add_run, runs_below
from support.commands import output_of
from support.manifests import detected, estimated, log_account
from support.refusals import refusal
from support.scenes import shorten
from support.trees import tree

SET_BACK = TimeSegments(
    segments=(
        TimeSegment(0, 0, 1, 2, 1, 2, Cause.START),
        TimeSegment(1, 5, 5, 9, 3, 7, Cause.SET_BACK, None, -2, breaks_odometry=True),
    ),
    clocks=(LogClock((Epoch(0, 0), Epoch(5, 2)), {"/a": EpochMarks((3, None), (7,), ((1, 2),))}),),
    notices=("set back",),
)
RICH = detected("/cam", {"finder": "objects"}, time=SET_BACK)
LOST = account([log_account("a", "/t", used=7, skipped={"dull": 2}, dropped={"cut": 1})])


@pytest.mark.parametrize(
    "manifest",
    [estimated(), estimated(detect=RICH, account=LOST), RICH],
    ids=["bare", "rich", "detect"],
)
def test_manifest_is_read_back_unchanged(manifest: Manifest, tmp_path: Path) -> None:
    run = create(tmp_path / "run", overwrite=False)
    write_manifest(run, manifest)
    first = run.file("manifest.json").read_bytes()

    assert run.manifest() == manifest
    write_manifest(run, run.manifest())
    assert run.file("manifest.json").read_bytes() == first


@pytest.mark.parametrize("command", ["score", "estimate", "view"])
def test_single_drive_commands_refuse_merged_run_in_one_line(command: str, tmp_path: Path) -> None:
    merged = create(tmp_path / "merged", overwrite=False).path
    merge_runs({}, RunFolder(merged), {})

    assert "many drives" in refusal(1, command, merged)


@pytest.mark.parametrize(("text", "message"), [("{", "unreadable"), ("[1]", "format None")])
def test_manifest_that_is_no_object_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "manifest.json").write_text(text)

    with pytest.raises(RunError, match=message):
        open_run(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format_version": 2}, rf"format 2, this crosscue reads {FORMAT_VERSION}: replay again"),
        ({"format_version": None}, r"format None"),
        ({"stage": "dream"}, r"stage: .*'dream'.*replay again"),
        ({"settings": {"version": 1, "wings": 2}}, r"settings: wings: extra inputs.*replay again"),
        ({"notices": "none"}, r"notices: .*replay again"),
        ({"pose": {"rows": "7", "travelled_m": 0.0, "major_axis_m": None}}, r"pose\.rows: "),
        ({"colour": "red"}, r"colour: extra inputs are not permitted"),
    ],
)
def test_invalid_manifest_is_refused_in_one_line(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    run = create(tmp_path / "run", overwrite=False)
    write_manifest(run, estimated())
    path = run.file("manifest.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    with pytest.raises(RunError, match=message) as error:
        open_run(run.path)
    assert "\n" not in str(error.value)


def test_schema_of_the_truth_is_printed() -> None:
    assert json.loads(output_of("truth", "schema"))["title"] == "Truth"


def test_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "old")

    def fail(partial: Path) -> None:
        partial.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match="disk is full"):
        write_whole(tmp_path / "a.txt", fail)

    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Two drives, each with two settings."""
    return runs_below(tmp_path / "fleet")


def test_tags_are_set_listed_and_removed(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    monday, tuesday = str(runs / "a/monday"), str(runs / "a/tuesday")

    assert cli.run(["tag", monday, tuesday, "weather=rain", "route=5 = north", "--json"]) == 0
    both = {"weather": "rain", "route": "5 = north"}
    assert json.loads(capsys.readouterr().out) == {monday: both, tuesday: both}

    assert cli.run(["tag", monday, "weather=dry", "--remove", "route", "-q"]) == 0
    capsys.readouterr()
    assert output_of("tag", runs / "a").splitlines() == [
        f"{monday}  weather=dry",
        f"{tuesday}  route=5 = north weather=rain",
    ]


def test_copies_of_a_run_with_different_tags_are_not_merged(runs: Path) -> None:
    add_run(runs / "copy/monday", "monday")
    gathered([runs / "a", runs / "copy"])
    crosscue.tag_runs([runs / "copy/monday"], {"weather": "rain"})

    with pytest.raises(UsageError, match="one run with different tags"):
        gathered([runs / "a", runs / "copy"])


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["weather="], "weather=: expected KEY=VALUE"),
        (["1weather=rain"], "expected KEY=VALUE"),
        (["weather=a\nb"], "expected KEY=VALUE"),
        (["weather=rain", "weather=dry"], "weather: set twice"),
        (["weather=rain", "--remove", "weather"], "set twice, or set and removed"),
        (["--remove", "a b"], "a b: not a valid key of a tag"),
    ],
)
def test_invalid_tags_are_refused_without_changes(
    runs: Path, argv: list[str], message: str
) -> None:
    before = tree(runs)

    assert message in refusal(2, "tag", runs / "a", *argv)
    assert tree(runs) == before


def test_damaged_tags_are_reported_and_not_overwritten(runs: Path) -> None:
    path = runs / "a/monday/tags.json"
    path.write_text('{"format_version": 1, "tags": {"weather": 3}}')

    with pytest.raises(UnreadableRunError, match=r"tags\.json: unreadable"):
        crosscue.tag_runs([runs / "a"], {"weather": "rain"})

    assert "3" in path.read_text()
    assert not (runs / "a/tuesday/tags.json").exists()
    assert "tags.json: unreadable" in crosscue.catalog(runs).left_out["a/monday"]


def test_removing_the_last_tag_restores_the_run_folder(runs: Path) -> None:
    before = tree(runs / "a/monday")

    crosscue.tag_runs([runs / "a/monday"], {"weather": "rain"})
    assert tree(runs / "a/monday") != before
    crosscue.tag_runs([runs / "a/monday"], remove=["weather", "never_set"])

    assert tree(runs / "a/monday") == before


KINDS = pa.dictionary(pa.int8(), pa.string())


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        ([1, None, 3], pa.int64()),
        (range(4), pa.int64()),
        (np.arange(10)[::2], pa.int64()),
        (np.arange(5, dtype=np.uint8), pa.int32()),
        (np.arange(3), pa.float64()),
        ([1.0, None, math.inf], pa.float64()),
        (np.array([1.5, -0.0], np.float32), pa.float64()),
        ([True, None, False], pa.bool_()),
        (np.arange(19) % 3 == 0, pa.bool_()),
        (("a", None, "", "größer"), pa.string()),
        (np.array(["a", "bb"]), pa.string()),
        (["x", "y", "x"], KINDS),
        ([[1.0], None, []], pa.list_(pa.float64())),
        ([b"a", None], pa.binary()),
        *(([], kind) for kind in (pa.int64(), pa.float64(), pa.bool_(), pa.string(), KINDS)),
    ],
    ids=str,
)
def test_column_equals_that_of_arrow(values: object, kind: pa.DataType) -> None:
    column = arrow_column(values, kind)

    column.validate(full=True)
    assert column.equals(pa.array(values, kind))


def test_missing_number_is_not_nan() -> None:
    column = arrow_column([math.nan, None], pa.float64())

    assert column.is_null().to_pylist() == [False, True]


@pytest.mark.parametrize(
    ("values", "kind"),
    [([1.5], pa.int64()), (["a"], pa.float64()), ([1], pa.bool_()), ([2**70], pa.int64())],
    ids=str,
)
def test_value_of_another_type_is_refused(values: object, kind: pa.DataType) -> None:
    with pytest.raises((TypeError, ValueError, OverflowError)):
        arrow_column(values, kind)


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
