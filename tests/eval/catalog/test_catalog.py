"""Tables of the runs below a folder."""

from pathlib import Path

import pytest

import crosscue
from crosscue.eval.batch.merge import merge_runs
from crosscue.eval.runs.account import Account, Line
from crosscue.eval.runs.folder import MANIFEST, TIMINGS, RunFolder, create, write_timings
from crosscue.eval.runs.manifest import Timings
from crosscue.replay.errors import UsageError
from support.catalog_runs import add_run, runs_below


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two drives, each with two settings."""
    return runs_below(tmp_path_factory.mktemp("fleet"))


def test_query_combines_the_tables_of_all_runs(runs: Path) -> None:
    found = crosscue.catalog(runs)

    for table in ("belief", "cues", "range", "frames"):
        parts = {
            str(path.relative_to(runs)): RunFolder(path).table(table).num_rows
            for path in found.runs
        }
        counted = found.query(f'select run, count(*) as n from "{table}" group by run').to_pylist()
        assert {row["run"]: row["n"] for row in counted} == parts


def test_dropped_rows_are_counted_by_reason(tmp_path: Path) -> None:
    lost = Line(entered=5, used=2, skipped={}, dropped={"cut": 3}, dropped_unknown=("torn",))
    account = Account(reading=(), detecting={"front": lost}, estimating={}, is_whole=False)
    add_run(tmp_path / "one", "one", account=account)

    found = crosscue.catalog(tmp_path)

    rows = found.query("select stage, stream, reason, rows from dropped order by reason")
    assert [tuple(row.values()) for row in rows.to_pylist()] == [
        ("detecting", "front", "cut", 3),
        ("detecting", "front", "torn", None),
    ]
    [run] = found.query("select outcome, exit_status, rows_dropped from runs").to_pylist()
    assert run == {"outcome": "losses", "exit_status": 3, "rows_dropped": 3}


@pytest.mark.parametrize(
    ("query", "named"),
    [
        ("(settings->>'$.fusion.established') = '0.3'", ["b/monday", "b/tuesday"]),
        ("name = 'monday' -- both", ["a/monday", "b/monday"]),
        ("", ["a/monday", "a/tuesday", "b/monday", "b/tuesday"]),
        ("select run from runs where name = 'monday' order by run desc", ["b/monday", "a/monday"]),
        ("from belief where run = 'a/monday'", ["a/monday"]),
        ("with x as (from runs) select run from x where false", []),
    ],
)
def test_condition_or_query_selects_runs(runs: Path, query: str, named: list[str]) -> None:
    assert crosscue.catalog(runs).select(query) == tuple(runs / name for name in named)


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("select name from runs", r"no column run in the result \(name\)"),
        ("select 'x' as run", "column run holds 'x', which is not a run of"),
        ("vehcle = 'car'", r"no column vehcle; did you mean vehicle\?"),
    ],
)
def test_invalid_selection_is_refused(runs: Path, query: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        crosscue.catalog(runs).select(query)


def test_merged_run_is_not_counted_again(tmp_path: Path) -> None:
    run = add_run(tmp_path / "runs/one", "one")
    merge_runs({"one": run}, create(tmp_path / "runs/merged", overwrite=False), {})

    found = crosscue.catalog(tmp_path)

    assert [path.name for path in found.runs] == ["one"]
    assert found.query("select count(*) as n from belief").to_pylist() == [{"n": 50}]


def test_unreadable_runs_are_left_out_and_reported(tmp_path: Path) -> None:
    add_run(tmp_path / "good", "good")
    manifest = add_run(tmp_path / "other", "other").file(MANIFEST)
    manifest.write_text(manifest.read_text().replace('"format_version": 8', '"format_version": 7'))
    add_run(tmp_path / "half", "half").file(MANIFEST).unlink()
    add_run(tmp_path / "torn", "torn").file(MANIFEST).write_text('{"format_version": 8, "stage"')

    found = crosscue.catalog(tmp_path)

    assert [path.name for path in found.runs] == ["good"]
    assert found.left_out.keys() == {"other", "half", "torn"}
    assert "format 7, this crosscue reads 8; replay again" in found.left_out["other"]
    assert "cut short" in found.left_out["half"]
    assert "unreadable" in found.left_out["torn"]
    listed = found.query("select run, reason from left_out").to_pylist()
    assert {row["run"]: row["reason"] for row in listed} == found.left_out


def test_damaged_tables_are_left_out_but_their_runs_are_kept(tmp_path: Path) -> None:
    for name in ("good", "gone", "torn", "pages"):
        add_run(tmp_path / name, name)
    found = crosscue.catalog(tmp_path)
    (tmp_path / "gone/belief.parquet").unlink()
    (tmp_path / "torn/belief.parquet").write_bytes(b"PAR1")
    path = tmp_path / "pages/belief.parquet"
    content = bytearray(path.read_bytes())
    content[100:160] = bytes(255 - byte for byte in content[100:160])
    path.write_bytes(content)

    rows = found.query('select run, count("left") as n, sum(t_ns) > 0 as ok from belief group by 1')

    assert rows.to_pylist() == [{"run": "good", "n": 50, "ok": True}]
    assert found.left_out.keys() == {"gone", "torn", "pages"}
    assert "belief.parquet: deleted" in found.left_out["gone"]
    assert "belief.parquet: damaged" in found.left_out["pages"]
    assert len(found.select("true")) == 4


def test_wall_time_comes_from_timings_file_which_may_be_missing_or_damaged(tmp_path: Path) -> None:
    for name in ("timed", "without", "torn"):
        write_timings(add_run(tmp_path / name, name), Timings(seconds=2.5))
    (tmp_path / "without" / TIMINGS).unlink()
    (tmp_path / "torn" / TIMINGS).write_text('{"seconds"')

    found = crosscue.catalog(tmp_path)

    rows = found.query("select run, seconds, exit_status from runs").to_pylist()
    assert {row["run"]: row["seconds"] for row in rows} == {
        "timed": 2.5,
        "without": None,
        "torn": None,
    }
    assert not found.left_out
