"""Presigned addresses: suffixes that are checked before a request, and stores that stall."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from crosscue.eval.cli import run as crosscue
from crosscue.replay.remote import logs as remote
from crosscue.replay.remote import ranges as remote_ranges
from crosscue.replay.remote import waiting
from support.can_files import candump, random_frames
from support.every_format import EVERY_FORMAT
from support.range_server import Served, serving

SIGNED = "?X-Amz-Expires=60&X-Amz-Credential=a%2Fb&X-Amz-Signature=abc/def.mcap"


@pytest.fixture
def web(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    """Start a web server; complete logs are stored in ``tmp_path/store``."""
    pytest.importorskip("aiohttp", reason="aiohttp, by which fsspec reads from the web, is missing")
    monkeypatch.setenv(remote.STORE_VARIABLE, str(tmp_path / "store"))
    with serving() as served:
        yield served


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

    ended = subprocess.run(
        [sys.executable, "-c", code, "info", f"{web.base}/{name}"],
        capture_output=True,
        text=True,
        timeout=40,
        check=False,
    )

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
