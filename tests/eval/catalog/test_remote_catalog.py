"""A catalog of runs on an object store: its content, and the bytes that it fetches."""

import io
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fsspec.implementations.memory import MemoryFileSystem

import crosscue
from crosscue.replay.errors import UnreadableRunError
from support.catalog_runs import add_run, runs_below

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


def _put(folder: Path, bucket: str) -> str:
    system = fsspec.filesystem("counted")
    for path in folder.rglob("*"):
        if path.is_file() and not path.name.startswith("."):
            system.pipe_file(f"/{bucket}/{path.relative_to(folder)}", path.read_bytes())
    return f"counted://{bucket}"


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
    before = os.environ.get("XDG_CACHE_HOME")
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))
    yield _put(folder, "fleet")
    if before is None:
        del os.environ["XDG_CACHE_HOME"]
    else:
        os.environ["XDG_CACHE_HOME"] = before


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
