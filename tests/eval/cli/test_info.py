"""``crosscue info`` prints the contents of a log, and ``crosscue query`` rows of runs."""

import csv
import json
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import crosscue
from crosscue.eval import cli
from crosscue.eval.cli import run
from crosscue.eval.logs.summary import lines_of
from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import DATA, Block, CanFrames, Topic
from crosscue.replay.errors import UsageError
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.log_summary import summarise_log
from crosscue.replay.safe_text import table, terminal_cells, visible, wrapped
from crosscue.results import plain
from support.catalog_runs import runs_below
from support.commands import json_of, output_of, python
from support.data import shared
from support.gap_drive import Clock, write_drive
from support.memory_log import START_NS, MemoryLog, Stream, table_of
from support.refusals import refusal
from support.trees import tree

MS = 1_000_000
HOSTILE = "/cam\x1b[31m\n\u202e\udcff\x00<b>"


@dataclass(frozen=True, slots=True, eq=False)
class LossyLog(MemoryLog):
    """A log in memory with losses, which declares its rows."""

    path: Path = Path("made.mcap")
    dropped: int = 0
    unknown: bool = False

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Yield the blocks and account for them."""
        yield from MemoryLog.read(self, ledger, selection)
        if self.dropped:
            ledger.drop(self.topics[0].name, "chunk CRC", self.dropped, "at byte 7", START_NS)
        if self.unknown:
            ledger.drop("", "file is cut", None, "at byte 9")
        for topic in self.topics:
            ledger.declare(topic.name, topic.declared)
            ledger.settle(topic.name)


def column_topic(
    name: str, type_name: str = "crosscue/Table", declared: int | None = None
) -> Topic:
    return Topic(name, type_name, "columns", declared=declared)


def can_block(bus: str, ids: list[int], extended: list[bool]) -> Block:
    n = len(ids)
    frames = CanFrames(
        np.array(ids, dtype=np.uint32),
        np.array(extended, dtype=np.bool_),
        np.full(n, DATA, dtype=np.uint8),
        np.full(n, 8, dtype=np.uint8),
        np.zeros((n, 8), dtype=np.uint8),
        np.zeros(n, dtype=np.bool_),
    )
    return Block(bus, START_NS + MS * np.arange(n, dtype=np.int64), frames)


def example_log(**changes: Any) -> LossyLog:
    stream = Stream(300, 50 * MS, wait_ns=MS)
    blocks = (
        table_of("/imu", stream.log_ns(), stream.header_ns()),
        can_block("can0", [0x100, 0x100, 0x100, 0x200] * 5, [False, True, False, False] * 5),
    )
    topics = (
        column_topic("/imu", "sensor_msgs/msg/Imu", 300 + changes.get("dropped", 0)),
        column_topic("can0", "crosscue/CanFrames"),
    )
    return LossyLog(topics, blocks, **changes)


def test_losses_are_reported_by_topic_reason_and_place() -> None:
    summary = summarise_log(example_log(dropped=31, unknown=True))
    text = "\n".join(lines_of(summary, 100))

    assert not summary.is_whole
    assert "- /imu: 31 of 331 rows dropped: chunk CRC" in text
    assert "- 31 of /imu at 0.00 s: chunk CRC (at byte 7)" in text
    assert "- an unknown number of unknown topics: file is cut (at byte 9)" in text
    assert "- at least 0 rows of unknown topics dropped: file is cut" in text
    assert re.search(r"^\(topic not known\) .*>= 0$", text, re.M)


def test_hostile_names_are_escaped_in_text_and_json() -> None:
    stream = Stream(40, 50 * MS)
    log = LossyLog(
        (Topic(HOSTILE, HOSTILE, "columns"),),
        (table_of(HOSTILE, stream.log_ns() * 0),),
        dropped=1,
        path=Path(HOSTILE),
    )

    summary = summarise_log(log)

    for part in lines_of(summary, 80):
        for line in part.split("\n"):
            assert line.isprintable(), line
    text = strict_json(plain(summary))
    text.encode("utf-8")
    assert "\\\\x1b[31m" in text


@given(
    st.lists(st.tuples(st.text(max_size=90), st.text(max_size=60)), max_size=4),
    st.integers(40, 120),
)
@settings(max_examples=60)
def test_tables_and_sentences_fit_the_terminal_width(
    rows: list[tuple[str, str]], width: int
) -> None:
    cut = list(table(("topic", "type", "count"), [(*r, "123456") for r in rows], width, (0, 1)))

    assert len(cut) == len(rows) + 1
    for line in [*cut, *(part for r in rows for part in wrapped(r[0], width).split("\n"))]:
        assert terminal_cells(line) <= width
        assert "\x1b" not in line


@pytest.mark.parametrize(
    ("raw", "safe"),
    [
        ("plain /topic", "plain /topic"),
        ("grün 日本", "grün 日本"),
        ("\x1b[2J", "\\x1b[2J"),
        ("a\nb", "a\\nb"),
        ("\u202egnp", "\\u202egnp"),
        ("\udcff", "\\udcff"),
    ],
)
def test_visible_text_keeps_letters_and_escapes_the_rest(raw: str, safe: str) -> None:
    assert visible(raw) == safe


def test_info_of_two_logs_as_json_combines_them(capsys: pytest.CaptureFixture[str]) -> None:
    segment = next(shared("comma2k19", "Example_1").glob("*/*"))

    status = run(["info", "--json", str(segment), str(segment)])

    tree = json.loads(capsys.readouterr().out)
    assert status == 3
    assert [log["format"] for log in tree["logs"]] == ["comma2k19", "comma2k19"]
    assert tree["together"]["findings"] == []
    assert tree["together"]["start_ns"] == tree["logs"][0]["start_ns"]


@pytest.mark.parametrize(
    ("clock", "car", "causes"),
    [
        (Clock(), True, ["start"]),
        (Clock(pause_s=(5.0, 9.0)), True, ["start", "odometry silent"]),
        (Clock(set_at_s=6.0, by_s=1200.0), True, ["start", "odometry silent"]),
        (Clock(set_at_s=6.0, by_s=-10.0), True, ["start", "clock set back"]),
        (Clock(set_at_s=6.0, by_s=-10.0), False, ["start", "clock set back"]),
    ],
)
def test_time_segments_are_listed_and_several_exit_3(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], clock: Clock, car: bool, causes: list[str]
) -> None:
    words = ["info", str(write_drive(tmp_path, clock))]
    words += ["--vehicle", str(tmp_path / "car.toml")] if car else []
    status = 0 if len(causes) == 1 else 3

    assert run([*words, "--json"]) == status
    found = json.loads(capsys.readouterr().out)["time"]["segments"]
    assert [one["cause"] for one in found] == causes
    assert run(words) == status
    text = capsys.readouterr().out
    assert all(cause in text for cause in causes[1:])
    assert ("2 time segments" in text) is (len(causes) == 2)
    assert json_of(*words, "--quick")["time"] is None


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
    for name in ("runs", "approaches", "cues", "scores", "belief", "range", "pose", "dropped"):
        assert (name, "run") in listed
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
