"""Parts of remote logs: the same rows as from a local file, with only the part transferred."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

import crosscue
from crosscue.replay.base import Selection
from crosscue.replay.columns import Block
from crosscue.replay.errors import LogError
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
from crosscue.replay.remote import ranges as remote_ranges
from crosscue.replay.remote.logs import RangedLog, RemoteLog
from support.range_server import Served
from support.rosbag_files import rows_of, write_bag

MS = 1_000_000


def mcap_log(path: Path, seconds: int = 40) -> Path:
    """Write a hundred vectors and 50 kB of noise per second, in chunks of 100 kB."""
    rng = np.random.default_rng(3)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=100_000, compression=CompressionType.ZSTD)
        writer.start(profile="ros2")
        vector = writer.register_schema(
            "geometry_msgs/msg/Vector3", "ros2msg", b"float64 x\nfloat64 y\nfloat64 z"
        )
        speed = writer.register_channel("/speed", "cdr", vector)
        noise = writer.register_channel("/noise", "secret", 0)
        for i in range(100 * seconds):
            t_ns = 10 * MS * i
            values = np.array([i, 0, 0], "<f8").tobytes()
            writer.add_message(speed, t_ns, b"\x00\x01\x00\x00" + values, t_ns)
            if i % 20 == 0:
                writer.add_message(noise, t_ns, rng.bytes(10_000), t_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def times(blocks: Iterator[Block]) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    for block in blocks:
        found.setdefault(block.topic, []).extend(block.log_ns.tolist())
    return found


def test_window_of_remote_mcap_transfers_only_its_chunks(tmp_path: Path, web: Served) -> None:
    path = mcap_log(tmp_path / "log.mcap")
    web.files["drives/log.mcap"] = path.read_bytes()
    window = Selection(None, 20_000 * MS, 24_000 * MS)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    needed = sum(
        chunk.chunk_length + chunk.message_index_length
        for chunk in summary.chunk_indexes
        if chunk.message_end_time >= 20_000 * MS and chunk.message_start_time < 24_000 * MS
    )
    here, there = Ledger("here"), Ledger("there")
    with open_log(path) as log:
        expected = times(log.read(here, window))

    with crosscue.open(f"{web.base}/drives/log.mcap") as drive:
        opened = web.sent
        assert drive.part(20.0, 24.0).selection == window
        assert isinstance(drive.logs[0], RangedLog)
        found = times(drive.logs[0].read(there, window))

    assert found == expected
    assert there.accounts == here.accounts
    assert there.integrity == here.integrity
    assert opened < 80_000
    assert needed <= web.sent - opened <= 1.15 * needed
    assert f"{web.sent} of {path.stat().st_size} bytes were fetched" in there.notices
    assert not (tmp_path / "store").exists()


@pytest.mark.slow
def test_window_of_remote_bag_transfers_only_its_chunks(tmp_path: Path, web: Served) -> None:
    rows = rows_of(20_000)
    path = write_bag(tmp_path / "a.bag", rows, chunk_bytes=64_000)
    web.files["a.bag"] = path.read_bytes()
    window = Selection(None, rows[8_000].log_ns, rows[10_000].log_ns)
    with open_log(path) as log:
        expected = times(log.read(Ledger("here"), window))

    with open_log(f"{web.base}/a.bag") as log:
        assert isinstance(log, RangedLog)
        opened = web.sent
        found = times(log.read(Ledger("there"), window))

    assert found == expected
    assert web.sent - opened < 1.5 * (2_000 / 20_000) * path.stat().st_size + 2 * 64_000
    assert opened < 0.1 * path.stat().st_size


def test_format_without_range_reads_is_downloaded_completely(web: Served) -> None:
    web.files["can.log"] = b"(1.000000) can0 123#00\n(2.000000) can0 123#01\n"
    ledger = Ledger("there")

    with open_log(f"{web.base}/can.log") as log:
        assert isinstance(log, RemoteLog)
        rows = sum(map(len, log.read(ledger, Selection(end_ns=1_500 * MS))))

    assert rows == 1
    assert any("downloaded completely" in notice for notice in ledger.notices)


def test_log_that_changes_while_read_is_refused(tmp_path: Path, web: Served) -> None:
    path = mcap_log(tmp_path / "log.mcap")
    web.files["log.mcap"] = path.read_bytes()

    with open_log(f"{web.base}/log.mcap") as log:
        blocks = log.read(Ledger("there"), Selection(end_ns=5_000 * MS))
        next(blocks)
        web.files["log.mcap"] += b"more"
        with pytest.raises(LogError, match="changed while it was read") as caught:
            list(blocks)

    assert "\n" not in str(caught.value)


def test_lost_connection_is_retried_a_limited_number_of_times(
    tmp_path: Path, web: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote_ranges, "WAITS_S", (0.0, 0.0))
    web.files["log.mcap"] = mcap_log(tmp_path / "log.mcap").read_bytes()
    with open_log(f"{web.base}/log.mcap") as log:
        web.failing = 2
        found = times(log.read(Ledger("there"), Selection(None, 9_000 * MS, 9_100 * MS)))
        assert len(found["/speed"]) == 10
        web.failing = 1000
        with pytest.raises(LogError, match=r"could not be read in 3 tries .*check the conn"):
            list(log.read(Ledger("there"), Selection(None, 30_000 * MS, 31_000 * MS)))


@pytest.mark.slow
def test_window_of_s3_object_transfers_only_its_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moto_server = pytest.importorskip("moto.server", reason="moto[s3] is not installed")
    s3fs = pytest.importorskip("s3fs", reason="s3fs is not installed")
    path = mcap_log(tmp_path / "log.mcap")
    for name in ("ACCESS_KEY_ID", "SECRET_ACCESS_KEY"):
        monkeypatch.setenv(f"AWS_{name}", "testing")
    server = moto_server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        s3fs.S3FileSystem.clear_instance_cache()
        store = s3fs.S3FileSystem(endpoint_url=f"http://{host}:{port}")
        store.mkdir("drives")
        store.pipe("drives/log.mcap", path.read_bytes())
        with open_log("s3://drives/log.mcap") as log:
            assert isinstance(log, RangedLog)
            speeds = [
                Selection(frozenset({"/speed"}), at * MS, (at + 2_000) * MS)
                for at in (20_000, 30_000)
            ]
            rows = sum(map(len, log.read(Ledger("s3"), speeds[0])))
            moved = log.ranged.transferred
            store.pipe("drives/log.mcap", path.read_bytes() + b"more")
            with pytest.raises(LogError, match=r"changed while it was read|could not be read"):
                list(log.read(Ledger("s3"), speeds[1]))
    finally:
        server.stop()
        s3fs.S3FileSystem.clear_instance_cache()
        os.environ.pop("AWS_ENDPOINT_URL", None)

    assert rows == 200
    assert moved < 80_000 + 1.5 * (2 + 2 * 2) / 40 * path.stat().st_size
