"""Remote logs: their addresses, fetched once until they change, and the transferred bytes."""

import copy
import json
import pickle
import time
import uuid
from collections.abc import Iterator
from functools import partial
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from crosscue.eval.cli import run as crosscue
from crosscue.replay.base import Selection
from crosscue.replay.columns import Block, Images, Topic
from crosscue.replay.errors import (
    LogError,
    LogTooLargeError,
    OutputError,
    UsageError,
    one_line,
    without_secrets,
)
from crosscue.replay.files.identity import SHARE_BYTES, log_identity
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
from crosscue.replay.remote import logs as remote
from crosscue.replay.remote import ranges as remote_ranges
from crosscue.replay.remote.address import LogAddress, is_remote
from crosscue.replay.remote.logs import Store, fetch_log
from crosscue.replay.write.convert import LogWriter
from crosscue.replay.write.mcap import McapWriter
from support.can_files import candump, random_frames
from support.commands import python
from support.every_format import EVERY_FORMAT
from support.memory_log import GYRO, WHEELS, gyro_block, wheel_block
from support.range_server import Served, serving
from support.ros_messages import messages_of
from support.rosbag_files import rows_of, write_bag
from support.trees import written

PUBLIC = {
    "http://user:hunter2@host/a.log": "http://host/a.log",
    "http://hunter2@host:81/deep/a.log?hunter2#hunter2": "http://host:81/deep/a.log",
    "HTTPS://host/a.log?X-Amz-Signature=hunter2/b": "https://host/a.log",
    "http://user:hunter2@[::1]:8000/a.log": "http://[::1]:8000/a.log",
    "http://user:p%40hunter2@host/a.log#hunter2": "http://host/a.log",
    "s3://key:hunter2@bucket/a.mcap?versionId=hunter2": "s3://bucket/a.mcap",
    "s3://bucket/run#3/what?.mcap": "s3://bucket/run#3/what?.mcap",
    "abfs://container@account.example/a.mcap?sig=hunter2": "abfs://container@account.example/a.mcap",
    "memory://bucket/a.log": "memory://bucket/a.log",
    "file:///drives/a.log": "file:///drives/a.log",
}
NOT_ADDRESSES = [
    "http://user:hunter2/with@host/a.log",
    "http://user:hunter2?with@host/a.log",
    "http://user:hunter2#with@host/a.log",
    "s3://key:hunter2/with@bucket/a.mcap",
    "filecache::http://user:hunter2@host/a.log",
    "zip://a.log::http://user:hunter2@host/a.zip",
]


@pytest.mark.parametrize("url", PUBLIC)
def test_every_text_of_an_address_is_public(url: str) -> None:
    address = LogAddress(url)

    texts = {
        str(address),
        f"{address}",
        f"{address:s}",
        "%s" % address,  # noqa: UP031
        address + "",
        "".join([address]),
        json.loads(json.dumps([address]))[0],
        *json.loads(json.dumps({address: 1})),
        repr(address).strip("'"),
        address.encode().decode(),
    }
    assert texts == {PUBLIC[url]}
    assert address == PUBLIC[url]
    assert hash(address) == hash(PUBLIC[url])
    assert without_secrets(f"<{url} : gone") == f"<{PUBLIC[url]} : gone".replace(
        "https", url[:5], 1
    )


@pytest.mark.parametrize("url", PUBLIC)
def test_complete_form_survives_copies_and_worker_processes(url: str) -> None:
    address = LogAddress(url)
    same = [
        address,
        LogAddress(address),
        str(address),
        copy.deepcopy(address),
        pickle.loads(pickle.dumps(address)),
    ]

    assert all(isinstance(one, LogAddress) for one in same)
    complete = {LogAddress(one).with_secrets() for one in same}

    assert len(complete) == 1
    assert LogAddress(complete.pop()) == address
    assert "hunter2" not in url or "hunter2" in address.with_secrets() + url.partition("#")[2]


@pytest.mark.parametrize("url", NOT_ADDRESSES)
def test_address_that_cannot_be_split_is_refused_without_quoting_it(url: str) -> None:
    assert is_remote(url)

    with pytest.raises(UsageError) as caught:
        LogAddress(url)

    assert "hunter2" not in str(caught.value)
    assert "hunter2" not in one_line(ValueError(f"no file {url}"))


def test_every_url_of_a_long_text_loses_its_secrets() -> None:
    text = (
        "a.b:/c, " + "x.-" * 50_000 + ",".join(["http://u:hunter2@h/a", "s3://k:hunter2@b/c?d=1"])
    )

    began = time.monotonic()
    assert without_secrets(text).endswith("http://h/a,s3://b/c")
    assert time.monotonic() - began < 2.0


def test_error_of_a_store_carries_no_secret_in_any_attribute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("aiohttp", reason="aiohttp, by which fsspec reads from the web, is missing")
    monkeypatch.setenv(remote.STORE_VARIABLE, str(tmp_path))
    urls = ["s3://key:hunter2@bucket/a.mcap", "nonsense://user:hunter2@bucket/a.mcap"]
    with serving() as web:
        web.password = "other"
        login = web.base.replace("//", "//user:hunter2@")
        urls += [f"{login}/a.log?hunter2", f"{login}/a.mcap?sig=hunter2#hunter2"]
        for url in urls:
            with pytest.raises(LogError) as caught:
                open_log(url)
            error: BaseException | None = caught.value
            while error is not None:
                assert "hunter2" not in f"{error} {error.args!r} {vars(error)}"
                error = error.__cause__ or error.__context__
        with pytest.raises(LogError, match=r"no permission \(403\); check credentials"):
            open_log(urls[-1])


@pytest.fixture
def bucket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Return an empty bucket's URL; downloads are stored in ``tmp_path/store``."""
    monkeypatch.setenv(remote.STORE_VARIABLE, str(tmp_path / "store"))
    name = f"bucket-{uuid.uuid4().hex}"
    system = import_module("fsspec").filesystem("memory")
    system.mkdir(f"/{name}")
    yield f"memory://{name}"
    system.rm(f"/{name}", recursive=True)


def _put(url: str, content: bytes) -> str:
    with import_module("fsspec").open(url, "wb") as file:
        file.write(content)
    return url


def test_log_is_fetched_once_until_it_changes(bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fetches: list[str] = []
    download = remote._download

    def counted(url: str, *rest: object) -> None:
        fetches.append(url)
        download(url, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(remote, "_download", counted)
    url = _put(f"{bucket}/a.log", b"one")
    for _ in range(2):
        with fetch_log(url) as fetched:
            assert fetched.path.read_bytes() == b"one"
    assert len(fetches) == 1

    _put(url, b"two")

    with fetch_log(url) as fetched:
        assert fetched.path.read_bytes() == b"two"
    assert len(fetches) == 2


@pytest.mark.parametrize(
    ("log", "files"),
    [
        ("images", ["images/a.png", "images/deep/b.png", "images/.c/d.png", "images/truth.json"]),
        ("v.mp4", ["v.mp4", "v.csv", "v.mp4.txt", "v.other"]),
        ("a.db3", ["a.db3", "a.db3-wal", "a.yaml"]),
    ],
)
def test_identity_of_several_remote_files_needs_no_download(
    log: str, files: list[str], bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = np.random.default_rng(3).bytes(3 * SHARE_BYTES)
    for name in files:
        place = tmp_path / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content)
        _put(f"{bucket}/drive/{name}", content)
    here = log_identity(tmp_path / log)

    with fetch_log(f"{bucket}/drive/{log}") as fetched:
        assert log_identity(fetched.path) == here
    monkeypatch.setenv(remote.STORE_VARIABLE, str(tmp_path / "empty"))
    assert log_identity(f"{bucket}/drive/{log}") == here
    assert not list((tmp_path / "empty").glob("*/log"))


def test_store_evicts_least_recently_used_log_not_in_use(bucket: str, tmp_path: Path) -> None:
    store = Store(tmp_path / "small", max_bytes=250)
    urls = [_put(f"{bucket}/{name}.log", name.encode() * 100) for name in "abcd"]

    with fetch_log(urls[0], store) as in_use:
        fetch_log(urls[1], store).close()
        fetch_log(urls[2], store).close()
        assert in_use.path.exists()
        with fetch_log(urls[3], store), pytest.raises(OutputError, match="full of logs in use"):
            fetch_log(urls[1], store)

    kept = {path.name for path in store.folder.rglob("*.log")}
    assert kept == {"a.log", "d.log"}
    with pytest.raises(LogTooLargeError, match=r"the store may hold.*CROSSCUE_STORE_GIB"):
        fetch_log(_put(f"{bucket}/large.log", bytes(300)), store)


def test_log_that_changes_during_fetch_is_refused(
    bucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = _put(f"{bucket}/a.log", b"abc")
    chunks = remote._chunks

    def grow_after_reading(*args: object) -> Iterator[bytes]:
        yield from chunks(*args)  # type: ignore[arg-type]
        _put(url, b"abcdef")

    monkeypatch.setattr(remote, "_chunks", grow_after_reading)

    with pytest.raises(LogError, match="changed while it was fetched"):
        fetch_log(url)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("memory://nowhere/a.log", "no such object"),
        ("s3://bucket/a.log", "s3"),
        ("nonsense://a/b.log", "nonsense"),
    ],
)
def test_unavailable_url_is_refused_in_one_line(
    url: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(remote.STORE_VARIABLE, str(tmp_path))

    with pytest.raises(LogError, match=message) as caught:
        open_log(url)

    assert "\n" not in str(caught.value)
    assert url in str(caught.value)


def test_failed_fetch_leaves_no_file(
    bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = _put(f"{bucket}/a.log", b"abc")
    short = remote._Object(f"{bucket.removeprefix('memory:/')}/a.log", "a.log", 5, "")
    monkeypatch.setattr(remote, "_objects", lambda *_: [short])

    with pytest.raises(LogError, match=r"a\.log is not as long as its store reports"):
        fetch_log(url)

    assert not list((tmp_path / "store").rglob("a.log"))


SIGNED = "?X-Amz-Expires=60&X-Amz-Credential=a%2Fb&X-Amz-Signature=abc/def.mcap"


def test_presigned_log_is_read_like_a_local_one(
    web: Served, capsys: pytest.CaptureFixture[str]
) -> None:
    web.files["a.log"] = candump(random_frames(50))
    web.password = "abc"

    assert crosscue(["info", f"{web.base}/a.log{SIGNED}"]) == 0

    assert f"{web.base}/a.log " in capsys.readouterr().out
    assert {path for path in web.requests if "log" not in path} == set()


@pytest.mark.parametrize(("name", "stalling"), [("a.log", "body"), ("a.mcap", "headers")])
def test_stalled_server_is_reported_then_given_up(
    name: str, stalling: str, tmp_path: Path, web: Served
) -> None:
    kind = "candump" if name == "a.log" else "mcap"
    web.files[name] = EVERY_FORMAT[kind](tmp_path).read_bytes()
    web.stalling = stalling
    code = (
        "import sys\n"
        "from crosscue.eval.cli import main\n"
        "from crosscue.replay.remote import ranges\n"
        "ranges.NOTICE_S, ranges.LIMIT_S = 1.0, 3.0\n"
        "main(sys.argv[1:])\n"
    )

    ended = python(code, "info", f"{web.base}/{name}", timeout=40)

    assert ended.returncode == 4
    log = f"crosscue: {web.base}/{name}: no answer to a request for"
    # On a busy machine, the request before the stalled one may be slow, too.
    assert [*dict.fromkeys(ended.stderr.splitlines())] == [
        f"{log} 1 s; it ends after 3 s",
        f"{log} 3 s; check the connection",
    ]
    assert not list(tmp_path.glob("store/*/log"))


def test_limits_are_those_that_the_page_states() -> None:
    page = (Path(__file__).parents[2] / "docs" / "howto" / "many_drives.md").read_text()

    assert remote_ranges.NOTICE_S <= 10.0
    assert f"after {remote_ranges.NOTICE_S:g} s" in page
    assert f"after {remote_ranges.LIMIT_S:g} s" in page
    assert remote.CHUNK_BYTES == remote_ranges.PIECE == 4 << 20


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
