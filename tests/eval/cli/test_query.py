"""``crosscue query`` prints and writes rows, and is read-only."""

import csv
import json
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import crosscue
from crosscue.eval import cli
from crosscue.replay.errors import UsageError
from support.catalog_runs import runs_below
from support.child import python
from support.commands import json_of, output_of
from support.refusals import refusal
from support.trees import tree

SQL = "select run, approaches, tags, conditions, travelled_m, made_at from runs order by run"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two drives, each with two settings."""
    return runs_below(tmp_path_factory.mktemp("fleet"))


def test_all_output_formats_contain_the_same_rows(runs: Path, tmp_path: Path) -> None:
    records = json_of("query", runs, SQL)
    printed = list(csv.DictReader(output_of("query", runs, SQL, "--csv").splitlines()))
    for suffix in ("parquet", "csv", "json"):
        assert cli.run(["query", str(runs), SQL, "-o", str(tmp_path / f"x.{suffix}"), "-q"]) == 0

    assert [row["run"] for row in records] == [row["run"] for row in printed]
    assert records[0]["tags"] == json.loads(printed[0]["tags"]) == {}
    assert json.loads((tmp_path / "x.json").read_text()) == records
    assert list(csv.DictReader((tmp_path / "x.csv").read_text().splitlines())) == printed
    assert pq.read_table(tmp_path / "x.parquet").equals(crosscue.catalog(runs).query(SQL))


def test_schema_lists_tables_and_columns(runs: Path) -> None:
    listed = {(row["table"], row["column"]) for row in json_of("query", runs, "--schema")}
    for table in ("runs", "approaches", "cues", "scores", "belief", "range", "pose", "dropped"):
        assert (table, "run") in listed
    assert ("frames", "run, ...") in listed


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "expected either SQL or --schema"),
        (["from runs", "--schema"], "expected either SQL or --schema"),
        (
            ["from runs", "-o", "x.xlsx"],
            "x.xlsx: expected a name that ends in .parquet, .csv, .json",
        ),
        (["select vehcle from runs"], "no column vehcle; did you mean vehicle?"),
        (["select r.vehcle from runs r"], "no column vehcle; did you mean vehicle?"),
        (["from belif"], "no table belif; did you mean belief?"),
        (["selct 1"], "syntax error"),
        (["select 1; select 2"], "expected a single SELECT, found SELECT, SELECT"),
        (["select vehicle::int from runs"], "could not convert"),
    ],
)
def test_invalid_query_is_refused_in_one_line(runs: Path, argv: list[str], message: str) -> None:
    assert message.lower() in refusal(2, "query", runs, *argv).lower()


@pytest.mark.parametrize(
    "sql",
    [
        "copy runs to '{place}'",
        "copy (select 1) to '{place}' (format parquet)",
        "attach '{place}'",
        "export database '{place}'",
        "import database '{place}'",
        "create table x as select 1",
        "insert into runs select * from runs",
        "drop view runs",
        "install httpfs",
        "load httpfs",
        "pragma database_list",
        "set enable_external_access = true",
        "reset enable_external_access",
        "call pragma_version()",
        "explain analyze select 1",
        "select 1; copy runs to '{place}'",
        "create secret (type s3)",
        "from read_csv('{secret}')",
        "from read_text('{secret}')",
        "from read_blob('{secret}')",
        "from read_json('{secret}')",
        "from read_parquet('{secret}')",
        "from '{secret}'",
        "from glob('{secret}')",
        "from sniff_csv('{secret}')",
        "from parquet_metadata('{secret}')",
        "from read_csv('http://127.0.0.1:9/x.csv')",
        "from read_parquet('s3://bucket/x.parquet')",
        "from enable_logging(storage = 'file', storage_path = '{place}')",
        "from query('copy runs to ''{place}''')",
        "select getenv('HOME')",
        "with x as (copy runs to '{place}') from x",
        "from in_python",
    ],
)
def test_query_cannot_access_files_or_change_data(
    runs: Path, tmp_path: Path, sql: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    in_python = pa.table({"run": ["secret"]})
    secret = tmp_path / "secret.csv"
    secret.write_text("a,b\n1,2\n")
    found = crosscue.catalog(runs)
    before = (tree(runs), sorted(tmp_path.iterdir()))

    with pytest.raises(UsageError) as refused:
        found.query(sql.format(place=tmp_path / "made", secret=secret))

    assert "\n" not in str(refused.value)
    assert in_python.num_rows
    assert (tree(runs), sorted(tmp_path.iterdir())) == before


@pytest.mark.skipif(sys.platform != "linux", reason="limits memory with /proc and RLIMIT_AS")
def test_result_that_exceeds_memory_is_refused_in_one_line(runs: Path) -> None:
    """3e8 rows of 8 bytes do not fit in another 2 GiB."""
    script = (
        "import resource, sys\n"
        "from crosscue.eval import cli\n"
        "from crosscue.eval.catalog.query.catalog import catalog\n"
        "catalog(sys.argv[1]).query('select 1')\n"
        "used = 4096 * int(open('/proc/self/statm').read().split()[0])\n"
        "resource.setrlimit(resource.RLIMIT_AS, (used + (2 << 30), used + (2 << 30)))\n"
        "sys.exit(cli.run(['query', sys.argv[1], 'select * from range(300000000)']))\n"
    )
    done = python(script, runs)

    assert "query: the result does not fit in memory; select fewer rows" in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""
    assert done.returncode == 2
