"""A catalog on an object store, runs named on the command line, and the queries of the page."""

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import fsspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fsspec.implementations.memory import MemoryFileSystem

import crosscue
from crosscue.eval import cli
from crosscue.eval.batch.merge import merge_runs
from crosscue.eval.catalog.find_runs import runs_of
from crosscue.eval.catalog.query.catalog import Catalog
from crosscue.eval.runs.account import Account, Line
from crosscue.eval.runs.folder import create, write_manifest
from crosscue.replay.errors import CrosscueError, UnreadableRunError
from support.catalog_runs import add_run, runs_below
from support.manifests import detected, estimated
from support.scoring import (
    CUES,
    approach,
    belief_table,
    cue_table,
    frame_table,
    range_table,
    span,
    truth,
    truth_folder,
)

ROWS = 200_000


class _CountedReader(io.BytesIO):
    def read(self, size: int | None = -1, /) -> bytes:
        content = super().read(size)
        CountedStore.fetched.append(len(content))
        return content


class CountedStore(MemoryFileSystem):  # type: ignore[misc]
    """A store in memory that counts the bytes read from its objects."""

    protocol = "counted"
    store: dict[str, Any] = {}  # noqa: RUF012 (declared as in its base class)
    fetched: list[int] = []  # noqa: RUF012

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(super()._strip_protocol(path.replace("counted://", "memory://")))

    def _open(self, path: str, mode: str = "rb", **more: Any) -> Any:
        if mode == "rb":
            return _CountedReader(super()._open(path, mode, **more).getvalue())
        return super()._open(path, mode, **more)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two drives, each with two settings; one has a long pose table of many row groups."""
    folder = runs_below(tmp_path_factory.mktemp("fleet"))
    rng = np.random.default_rng(3)
    names = ("x_m", "y_m", "heading_rad", "speed_mps", "major_axis_m")
    table = pa.table(
        {"t_ns": np.arange(ROWS) * 10**7, **{name: rng.normal(size=ROWS) for name in names}}
    )
    pq.write_table(
        table, folder / "a/monday/pose.parquet", row_group_size=8192, write_page_checksum=True
    )
    (folder / "c").mkdir()
    add_run(folder / "c/half", "half").file("manifest.json").unlink()
    return folder


@pytest.fixture(scope="module")
def url(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The same runs on a store."""
    fsspec.register_implementation("counted", CountedStore, clobber=True)
    system = fsspec.filesystem("counted")
    for path in folder.rglob("*"):
        if path.is_file() and not path.name.startswith("."):
            system.pipe_file(f"/fleet/{path.relative_to(folder)}", path.read_bytes())
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield "counted://fleet"


@pytest.mark.parametrize(
    "sql",
    [
        "select * exclude made_at from runs order by run",
        "select * from approaches order by all",
        "select * from belief order by all",
        "select run, count(*) as n from pose group by run",
        "select * from left_out",
    ],
)
def test_remote_catalog_equals_local_catalog(folder: Path, url: str, sql: str) -> None:
    assert crosscue.catalog(url).query(sql).equals(crosscue.catalog(folder).query(sql))


def test_queries_fetch_only_required_columns_and_row_groups(url: str) -> None:
    size = len(CountedStore.store["/fleet/a/monday/pose.parquet"].getvalue())
    found = crosscue.catalog(url)

    def fetched(sql: str) -> int:
        CountedStore.fetched.clear()
        found.query(sql)
        return sum(CountedStore.fetched)

    footer = fetched("select count(*) from pose")
    one_column = fetched("select avg(x_m) from pose")
    one_group = fetched("select avg(x_m) from pose where t_ns < 1000")
    assert fetched("select * from pose") >= size * 0.99
    assert footer < one_group < footer + size / 41
    assert one_group < one_column < footer + size / 5
    assert fetched("select avg(approaches) from runs") == 0


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("counted://nowhere", "nothing there|neither a run folder nor a folder of runs"),
        ("nonsense://bucket/runs", "nonsense"),
    ],
)
def test_unreadable_store_is_reported(url: str, place: str, message: str) -> None:
    with pytest.raises(UnreadableRunError, match=message):
        crosscue.catalog(place)


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for name, stage in (
        ("a", "estimate"),
        ("b", "estimate"),
        ("deep/c", "estimate"),
        ("merged", "merged"),
    ):
        run = create(tmp_path / "runs" / name, overwrite=False)
        if stage == "merged":
            merge_runs({}, run, {})
        else:
            write_manifest(run, estimated())
    (tmp_path / "runs" / "empty").mkdir()
    (tmp_path / "runs" / ".drives").mkdir()
    return tmp_path / "runs"


def test_folder_names_its_runs_but_not_their_merged_run(runs: Path) -> None:
    assert runs_of([str(runs)]) == (runs / "a", runs / "b", runs / "deep" / "c")


def test_patterns_and_list_files_are_expanded(runs: Path) -> None:
    runs.parent.joinpath("runs.txt").write_text("# two\nruns/b\n\nruns/a\n")

    assert runs_of([f"{runs}/[ab]"]) == (runs / "a", runs / "b")
    assert runs_of([f"@{runs.parent}/runs.txt"]) == (runs / "b", runs / "a")


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("{}/empty", "neither a run folder nor a folder of runs"),
        ("{}/z*", "nothing matches"),
        ("@{}/gone", "No such file"),
        ("@{}/a/manifest.json", "neither|names no run|no run folder"),
    ],
)
def test_invalid_run_arguments_are_refused_in_one_line(
    runs: Path, argument: str, message: str
) -> None:
    if "manifest" in argument:
        (runs / "a" / "manifest.json").write_text("# nothing\n")

    with pytest.raises(CrosscueError, match=message) as caught:
        runs_of([argument.format(runs)])

    assert "\n" not in str(caught.value)


PAGE: Final = Path(__file__).parents[3] / "docs" / "howto" / "query.md"
PAGE_QUERIES: Final = re.findall(r"```sql\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture(scope="module")
def catalog(tmp_path_factory: pytest.TempPathFactory) -> Catalog:
    """Small runs with data for all queries: one approach each, in rain, within 30 m."""
    folder = tmp_path_factory.mktemp("fleet")
    runs = runs_below(folder / "runs")
    signs = detected("front", {"signs": "objects"})
    late = {
        "frames": frame_table(50),
        "cues": cue_table(CUES),
        "belief": belief_table({"intersection": {20: 0.95}, "left": {30: 0.97}}),
        "range": range_table(8, 45, 0.5),
    }
    lost = Line(entered=5, used=2, skipped={}, dropped={"cut": 3})
    account = Account(reading=(), detecting={"front": lost}, estimating={}, is_whole=False)
    add_run(runs / "c/wednesday", "wednesday", found=late, detect=signs, account=account)
    crosscue.tag_runs([runs / "a"], {"route": "north"})
    signs_there = [span("stop_sign", 0, 40, count=1, visible=1.0)]
    drive = truth(signs_there, [approach(conditions=("rain", "dusk"))])
    reported = truth_folder(folder / "truth", drive)
    for path in runs.rglob("manifest.json"):
        argv = ["score", str(path.parent), "--truth", str(reported), "--without-figures", "-q"]
        assert cli.run(argv) in (0, 3)
    return crosscue.catalog(runs)


def test_queries_of_the_page_return_expected_rows(catalog: Catalog) -> None:
    def rows(number: int) -> list[dict[str, Any]]:
        return list(catalog.query(PAGE_QUERIES[number - 1]).to_pylist())

    assert all(map(rows, range(1, len(PAGE_QUERIES) + 1)))
    assert rows(1) == [{"vehicle": "car", "crosscue": "0", "runs": 5, "with_losses": 1}]
    assert [row["run"] for row in rows(2)] == ["c/wednesday"]
    assert rows(3)[0]["detected_m"] == 20.0
    assert {row["first_m"] for row in rows(4)} == {30.0}
    assert rows(5)[0] | {"condition": ""} == rows(5)[1] | {"condition": ""}
    assert rows(5)[0]["mean_m"] == pytest.approx((4 * 30.0 + 20.0) / 5)
    assert rows(8) == [
        {"stage": "detecting", "stream": "front", "reason": "cut", "rows": 3, "runs": 1}
    ]
    assert [(row["route"], row["approaches"]) for row in rows(9)] == [("north", 2)]
