"""``crosscue info`` prints the contents of a log on any terminal, and as strict JSON."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.eval.cli import run
from crosscue.eval.logs.summary import lines_of
from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import DATA, Block, CanFrames, Topic
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.log_summary import summarise_log
from crosscue.replay.safe_text import table, terminal_cells, visible, wrapped
from crosscue.results import plain
from support.clock_streams import START_NS, Stream, table_of
from support.commands import json_of
from support.data import shared
from support.gap_drive import Clock, write_drive
from support.memory_log import MemoryLog

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
