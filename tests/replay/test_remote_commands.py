"""Commands on parts of remote logs, with the transferred bytes counted by the server."""

import json
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from crosscue.eval.cli import run as crosscue
from crosscue.replay.base import Selection
from crosscue.replay.columns import Block, Images, Topic
from crosscue.replay.files.identity import log_identity
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
from crosscue.replay.write.convert import LogWriter
from crosscue.replay.write.mcap import McapWriter
from support.can_files import candump, random_frames
from support.memory_log import GYRO, WHEELS, gyro_block, wheel_block
from support.range_server import Served
from support.ros_messages import messages_of
from support.rosbag_files import rows_of, write_bag
from support.trees import written

MS = 1_000_000
# Bytes of a log's head and tail, from which its identity is computed, and of the read-ahead.
FIXED_BYTES = 192 << 10
WINDOW = ("--from", "30", "--to", "34")
# A tenth of the drive, and head, tail, index and some chunks around it.
WINDOW_SHARE = 0.17
BRIGHT = "support.detecting:build"
ARGUMENTS = {
    "info": ["info", "--json"],
    "convert": ["convert", "-o", "OUT.mcap", "-q"],
    "decode": ["decode", "-o", "OUT", "-q"],
    "replay": ["replay", "-o", "OUT", "-q", "--detectors", BRIGHT, "--no-cache"],
    "detect": ["detect", "-o", "OUT", "-q", "--detectors", BRIGHT, "--no-cache"],
}


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write wheel speeds, yaw rates and ten noise images per second, in chunks of 100 kB."""
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    rng = np.random.default_rng(5)
    camera = Topic("camera", "crosscue/Images", "columns")
    with pytest.MonkeyPatch.context() as patch:
        small = partial(McapWriter, chunk_bytes=100_000)
        patch.setattr("crosscue.replay.write.convert.McapWriter", small)
        writer = LogWriter(path, Ledger("made"))
    with writer:
        for topic in (WHEELS, GYRO, camera):
            assert writer.add_topic(topic)
        for second in range(40):
            t_ns = [(1_000 + second * 1_000 + i * 100) * MS for i in range(10)]
            writer.write(wheel_block(t_ns, [10.0] * 10))
            writer.write(gyro_block(t_ns, [0.01] * 10))
            pixels = [rng.integers(0, 256, (100, 130, 3), np.uint8) for _ in t_ns]
            coded = [cv2.imencode(".png", one)[1].tobytes() for one in pixels]
            images = Images(messages_of(coded), ("png",) * 10)
            writer.write(Block("camera", np.array(t_ns, np.int64), images))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("command", ARGUMENTS)
def test_window_of_remote_log_transfers_its_chunks_and_yields_the_output_of_a_local_one(
    command: str, drive: Path, tmp_path: Path, web: Served, capsys: pytest.CaptureFixture[str]
) -> None:
    web.files["logs/drive.mcap"] = drive.read_bytes()
    printed = []
    for name, log in (("here", str(drive)), ("there", f"{web.base}/logs/drive.mcap")):
        words = [word.replace("OUT", str(tmp_path / name)) for word in ARGUMENTS[command]]
        assert crosscue([words[0], log, *words[1:], *WINDOW]) == 0
        printed.append(capsys.readouterr().out)

    assert web.sent < WINDOW_SHARE * drive.stat().st_size
    assert not list((tmp_path / "store").glob("*/log"))
    files = sorted(one.relative_to(tmp_path / "here") for one in tmp_path.glob("here/*.parquet"))
    for one in files:
        here, there = tmp_path / "here" / one, tmp_path / "there" / one
        if one.name == "skipped.parquet":
            # Its rows contain the log's name.
            tables = (pq.read_table(path).drop(["log"]) for path in (here, there))
            assert next(tables).equals(next(tables))
            continue
        assert there.read_bytes() == here.read_bytes()
    if command == "convert":
        assert (tmp_path / "there.mcap").read_bytes() == (tmp_path / "here.mcap").read_bytes()
    elif command == "info":
        local, remote_log = (json.loads(text)["logs"][0] for text in printed)
        assert local | {"path": "", "notices": []} == remote_log | {"path": "", "notices": []}
    else:
        assert files


@pytest.mark.slow
def test_replay_of_long_window_transfers_each_byte_once(
    drive: Path, tmp_path: Path, web: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A tenth of the log fits into memory, so the rest is cached in a temporary file.
    monkeypatch.setattr("crosscue.replay.remote.ranges.KEPT_BYTES", 1 << 20)
    monkeypatch.setattr("crosscue.replay.remote.ranges.PIECE", 512 << 10)
    web.files["drive.mcap"] = drive.read_bytes()
    call = [f"{web.base}/drive.mcap", "-o", str(tmp_path / "out"), "-q", "--from", "10"]

    status = crosscue(["replay", *call, "--detectors", BRIGHT, "--no-cache"])

    assert status == 0
    assert web.sent <= drive.stat().st_size + FIXED_BYTES


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mcap", "bag", "log"])
def test_remote_identity_equals_local_identity(
    kind: str, drive: Path, tmp_path: Path, web: Served
) -> None:
    path = drive
    if kind == "bag":
        path = write_bag(tmp_path / "a.bag", rows_of(60_000), chunk_bytes=64_000)
    elif kind == "log":
        path = written(tmp_path / "can.log", candump(random_frames(300)))
    web.files[f"deep/{path.name}"] = path.read_bytes()

    there = log_identity(f"{web.base}/deep/{path.name}")
    sent = web.sent

    assert there == log_identity(path)
    if kind != "log":
        assert path.stat().st_size > 4 << 20
        assert sent < 128 * 1024 + 0.1 * path.stat().st_size
    web.files[f"deep/{path.name}"] += b"x"
    assert log_identity(f"{web.base}/deep/{path.name}") != there


@pytest.mark.slow
def test_estimate_of_remote_window_transfers_only_the_window(
    drive: Path, tmp_path: Path, web: Served, capsys: pytest.CaptureFixture[str]
) -> None:
    web.files["drive.mcap"] = drive.read_bytes()
    out = tmp_path / "out"
    call = [f"{web.base}/drive.mcap", "-o", str(out), "-q", *WINDOW]
    assert crosscue(["replay", *call, "--detectors", BRIGHT, "--no-cache"]) == 0
    before = {one.name: one.read_bytes() for one in out.glob("*.parquet")}
    assert before
    web.sent = 0

    assert crosscue(["estimate", str(out), "-q"]) == 0

    assert {one.name: one.read_bytes() for one in out.glob("*.parquet")} == before
    assert web.sent < WINDOW_SHARE * drive.stat().st_size
    web.files["drive.mcap"] = drive.read_bytes()[:-9] + b"x" + drive.read_bytes()[-8:]
    assert crosscue(["estimate", str(out), "-q"]) == 4
    assert "has changed since" in capsys.readouterr().err
    del web.files["drive.mcap"]
    assert crosscue(["estimate", str(out), "-q"]) == 4
    assert {one.name: one.read_bytes() for one in out.glob("*.parquet")} == before


def test_missing_topic_of_remote_log_transfers_only_index(
    drive: Path, web: Served, capsys: pytest.CaptureFixture[str]
) -> None:
    web.files["drive.mcap"] = drive.read_bytes()

    with open_log(f"{web.base}/drive.mcap") as log:
        assert not list(log.read(Ledger(""), Selection(frozenset({"none"}), 0, 1)))
    assert crosscue(["info", "--quick", f"{web.base}/drive.mcap"]) == 0

    assert web.base in capsys.readouterr().out
    assert web.sent < 400_000
