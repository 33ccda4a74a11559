"""Remote logs are fetched once, until they change or their store stalls."""

import uuid
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from crosscue.eval.cli import run as crosscue
from crosscue.replay.errors import LogError, LogTooLargeError, OutputError
from crosscue.replay.files.identity import SHARE_BYTES, log_identity
from crosscue.replay.logs.opening import open_log
from crosscue.replay.remote import logs as remote
from crosscue.replay.remote import ranges as remote_ranges
from crosscue.replay.remote import waiting
from crosscue.replay.remote.logs import Store, fetch_log
from support.can_files import candump, random_frames
from support.child import python
from support.every_format import EVERY_FORMAT
from support.range_server import Served


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
        "from crosscue.replay.remote import waiting\n"
        "waiting.NOTICE_S, waiting.LIMIT_S = 1.0, 3.0\n"
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

    assert waiting.NOTICE_S <= 10.0
    assert f"after {waiting.NOTICE_S:g} s" in page
    assert f"after {waiting.LIMIT_S:g} s" in page
    assert remote.CHUNK_BYTES == remote_ranges.PIECE == 4 << 20
