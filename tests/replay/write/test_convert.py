"""``crosscue convert``: each row is written or counted; a file is complete or does not exist."""

import errno
import json
import os
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as PeerWriter
from rosbags.highlevel import AnyReader

from crosscue.eval.cli import run as crosscue
from crosscue.replay.columns import Block, Topic
from crosscue.replay.errors import OutputError
from crosscue.replay.files.partial_file import PartialFile
from crosscue.replay.ledger import Ledger
from crosscue.replay.write.convert import BAD_SCHEMA, NO_TYPE, TOO_EARLY, LogWriter
from crosscue.replay.write.mcap import ChannelMessages, Compression, McapWriter
from support.can_layouts import frames_of
from support.data import shared
from support.refusals import refusal
from support.ros_messages import messages_of, random_message, ros2_store, ros2_topic, serialized
from support.trees import contents, written

SCHEMA = b"float64 data\n"


def stretch_of(channel: int, log_ns: list[int], payloads: list[bytes]) -> ChannelMessages:
    n = len(log_ns)
    times = np.array(log_ns, np.int64)
    sequence = np.arange(n, dtype=np.uint32) + channel * 1000
    return ChannelMessages(channel, times, times + channel, sequence, messages_of(payloads, 2))


def messages_in_file_order(path: Path) -> list[tuple[str, int, int, int, bytes]]:
    """Return the messages that the mcap package reads, in stored order, with checksums verified."""
    with path.open("rb") as stream:
        reader = NonSeekingReader(stream, validate_crcs=True)
        return [
            (c.topic, m.log_time, m.publish_time, m.sequence, m.data)
            for _, c, m in reader.iter_messages(log_time_order=False)
        ]


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_each_message_is_stored_once_in_topic_order(
    seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    rng = np.random.default_rng(seed)
    path = tmp_path_factory.mktemp("mcap") / "o.mcap"
    written: dict[str, list[tuple[int, bytes]]] = {}
    compression: Compression = ("zstd", "lz4", "none")[int(rng.integers(0, 3))]
    with McapWriter(path, compression=compression, chunk_bytes=int(rng.integers(1, 900))) as writer:
        for _ in range(int(rng.integers(1, 6))):
            topic = f"/t{rng.integers(0, 3)}"
            channel = writer.add_channel(topic, "std_msgs/msg/Float64", SCHEMA)
            n = int(rng.integers(0, 60))
            times = rng.integers(0, 1000, n).tolist()
            payloads = [rng.bytes(int(rng.integers(0, 80))) for _ in range(n)]
            writer.write(stretch_of(channel, times, payloads))
            written.setdefault(topic, []).extend(zip(times, payloads, strict=True))

    stored = messages_in_file_order(path)
    for topic, messages in written.items():
        assert [(t, data) for name, t, _, _, data in stored if name == topic] == messages
    assert len(stored) == sum(map(len, written.values()))
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        by_index = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages()]
        summary = reader.get_summary()
    assert sorted(by_index) == sorted((n, t, d) for n, t, _, _, d in stored)
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(stored)
    if stored:
        assert summary.statistics.message_start_time == min(t for _, t, _, _, _ in stored)
        assert summary.statistics.message_end_time == max(t for _, t, _, _, _ in stored)


class FailingFile:
    """File whose writes fail with a full disk from the nth one on."""

    def __init__(self, inner: Any, nth: int) -> None:
        self.inner, self.left = inner, nth

    def write(self, content: bytes) -> int:
        """Write ``content``, or raise ``OSError`` because the disk is full."""
        self.left -= 1
        if self.left < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return int(self.inner.write(content))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)


def _write_with_failure(path: Path, nth: int, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = PartialFile.open
    with monkeypatch.context() as patch:
        patch.setattr(PartialFile, "open", lambda self: FailingFile(opened(self), nth))
        with McapWriter(path, chunk_bytes=100) as writer:
            channel = writer.add_channel("/a", "std_msgs/msg/Float64", SCHEMA)
            writer.write(stretch_of(channel, list(range(20)), [b"payload"] * 20))


def test_full_disk_leaves_no_file_and_one_line_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, nth = tmp_path / "o.mcap", 0
    while not path.exists():
        with suppress(OutputError):
            _write_with_failure(path, nth, monkeypatch)
        assert path.exists() or list(tmp_path.iterdir()) == []
        nth += 1

    assert nth > 10
    assert len(messages_in_file_order(path)) == 20
    with pytest.raises(OutputError, match=r"^[^\n]*disk is full[^\n]*$"):
        _write_with_failure(tmp_path / "other.mcap", 3, monkeypatch)


def write_source(path: Path, compression: CompressionType = CompressionType.ZSTD) -> None:
    """Write two ROS 2 topics, one invalid definition and one unsupported encoding with mcap."""
    rng = np.random.default_rng(0)
    store = ros2_store()
    with path.open("wb") as stream:
        writer = PeerWriter(stream, chunk_size=4000, compression=compression)
        writer.start(profile="ros2")
        channels = []
        for name, type_name in (("/imu", "sensor_msgs/msg/Imu"), ("/s", "std_msgs/msg/String")):
            topic = ros2_topic(name, type_name)
            schema = writer.register_schema(type_name, "ros2msg", topic.schema)
            channels.append((writer.register_channel(name, "cdr", schema), type_name))
        broken = writer.register_schema("made_msgs/msg/Bad", "ros2msg", b"not a definition ~~\n")
        bad = writer.register_channel("/bad", "cdr", broken)
        unsupported = writer.register_channel("/unsupported", "flatbuffer", 0)
        for i in range(60):
            for channel, type_name in channels:
                raw = serialized(store, random_message(rng, store, type_name), type_name)
                writer.add_message(channel, 10**9 * i + channel, raw, 10**9 * i, sequence=7 * i)
        for i in range(3):
            writer.add_message(bad, i, b"\x00\x01\x00\x00", i)
            writer.add_message(unsupported, i, b"abc", i)
        writer.finish()  # type: ignore[no-untyped-call]


def test_ros2_messages_are_copied_exactly_and_others_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = tmp_path / "in.mcap", tmp_path / "out.mcap"
    write_source(source)

    status = crosscue(["convert", str(source), "-o", str(out), "--json"])

    report = json.loads(capsys.readouterr().out)
    kept = [row for row in messages_in_file_order(source) if row[0] in ("/imu", "/s")]
    assert sorted(messages_in_file_order(out)) == sorted(kept)
    assert status == 3
    assert report["is_whole"] is False
    assert report["topics"]["/bad"]["skipped"] == {BAD_SCHEMA: 3}
    assert report["topics"]["/unsupported"]["skipped"] == {NO_TYPE: 3}
    for name in ("/imu", "/s"):
        assert report["topics"][name]["found"] == report["topics"][name]["written"] == 60
    with AnyReader([out]) as reader:
        read = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()]
    assert len(read) == 120


@pytest.mark.parametrize(
    ("arguments", "status", "complaint"),
    [
        ("in.mcap -o in.mcap --overwrite", 2, "is the log itself"),
        ("in.mcap -o out.bag", 2, "ends in .mcap"),
        ("in.mcap -o there.mcap", 1, "exists"),
        ("in.mcap -o out.mcap --from soon", 2, "--from soon"),
    ],
)
def test_invalid_arguments_are_refused_and_change_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: str, status: int, complaint: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write_source(tmp_path / "in.mcap")
    written(tmp_path / "there.mcap", b"mine")
    before = contents(tmp_path)

    assert complaint in refusal(status, "convert", *arguments.split())
    assert contents(tmp_path) == before


def test_rows_before_1970_are_skipped_and_counted(tmp_path: Path) -> None:
    ledger = Ledger("made")
    block = Block("can0", np.array([-5, 5], np.int64), frames_of(np.zeros((2, 8), np.uint8), 0))
    with LogWriter(tmp_path / "o.mcap", ledger) as writer:
        writer.add_topic(Topic("can0", "crosscue/CanFrames", "columns"))
        assert writer.write(block) == 1

    assert ledger.topic("can0").skipped == {TOO_EARLY: 1}
    assert [t for _, t, *_ in messages_in_file_order(tmp_path / "o.mcap")] == [5]


@pytest.mark.slow
@pytest.mark.parametrize(
    "parts",
    [
        ("bags", "sail_il", "run1.bag"),
        ("bags", "plotjuggler", "tilt_laser.bag"),
        ("bags", "evo", "nav2_turtlebot.mcap"),
        ("bags", "evo", "tf_example"),
    ],
    ids=lambda parts: parts[-1],
)
def test_real_bags_keep_their_messages(
    tmp_path: Path, parts: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = shared(*parts), tmp_path / "out.mcap"

    status = crosscue(["convert", str(source), "-o", str(out), "--json"])

    assert status == 0, capsys.readouterr().err
    before, after = _rosbags_values(source), _rosbags_values(out)
    assert before.keys() == after.keys()
    for topic in before:
        assert len(before[topic]) == len(after[topic])
        assert before[topic] == after[topic]


def _rosbags_values(path: Path) -> dict[str, list[tuple[int, str]]]:
    """Return all messages as strings, without the header counter of ROS 1."""
    found: dict[str, list[tuple[int, str]]] = {}
    with AnyReader([path]) as reader:
        for connection, t_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((t_ns, _as_text(message)))
    return {topic: sorted(rows) for topic, rows in found.items()}


def _as_text(value: Any) -> str:
    if hasattr(value, "__msgtype__"):
        # Constants belong to the definition; only ROS 1 has the header's counter.
        hidden = ("__msgtype__", "seq")
        names = [f.name for f in fields(value) if f.name not in hidden and not f.name.isupper()]
        return "{" + ", ".join(_as_text(getattr(value, name)) for name in names) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_as_text, value)) + "]"
    return repr(value.tolist()) if isinstance(value, np.ndarray) else repr(value)


def test_from_to_and_topics_select_messages(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = tmp_path / "in.mcap", tmp_path / "out.mcap"
    write_source(source)
    part = ["--topics", "/imu", "--from", "10000000000ns", "--to", "20000000000ns"]

    status = crosscue(["convert", str(source), "-o", str(out), *part, "--json"])

    report = json.loads(capsys.readouterr().out)
    assert status == 0
    assert {name: row["messages"] for name, row in report["written"].items()} == {"/imu": 10}
    for account in report["topics"].values():
        skipped, lost = sum(account["skipped"].values()), sum(account["dropped"].values())
        assert account["found"] == account["written"] + skipped
        if account["declared"] is not None:
            assert account["declared"] == account["found"] + lost
