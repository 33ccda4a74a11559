"""Addresses of logs: what their text drops, and that nothing else gets at it."""

import copy
import json
import pickle
import time
from pathlib import Path

import pytest

from crosscue.replay.errors import LogError, UsageError, one_line, without_secrets
from crosscue.replay.logs.opening import open_log
from crosscue.replay.remote import logs as remote
from crosscue.replay.remote.address import LogAddress, is_remote
from support.range_server import serving

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
