"""``convert --salvage``, and the reports of plain ``convert`` and ``info`` on a damaged log."""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path

import pytest

from crosscue.eval.cli import run as crosscue
from support.mcap_damage import sound_parts
from support.mcap_files import McapFile, channel, message, read_back, schema
from support.rosbag_files import read_rows, rows_of, write_bag


def cdr(i: int) -> bytes:
    """Return a CDR message of the definition ``int32 x``."""
    return b"\x00\x01\x00\x00" + struct.pack("<i", i)


@pytest.fixture
def damaged(tmp_path: Path) -> tuple[Path, int]:
    """Return an unchunked log with one of 600 records damaged, and that record's position."""
    records = [schema(1), channel(1, 1, "/a")]
    records += [message(1, 10**18 + i * 10**6, cdr(i)) for i in range(600)]
    coded = bytearray(McapFile(records, data_crc=True).coded())
    at = coded.index(records[300])
    coded[at : at + 30] = bytes(30)
    path = tmp_path / "damaged.mcap"
    path.write_bytes(coded)
    return path, at


@pytest.mark.parametrize("flags", [[], ["--salvage"]])
def test_convert_writes_readable_messages_and_exits_with_3(
    damaged: tuple[Path, int], tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str]
) -> None:
    path, at = damaged

    status = crosscue(["convert", str(path), "-o", str(tmp_path / "out.mcap"), *flags])

    printed = capsys.readouterr()
    assert status == 3
    spans = re.findall(r"bytes (\d+) to (\d+)", " ".join(printed.err.split()))
    assert any(at - 39 <= int(a) <= at and int(b) == at + 39 for a, b in spans)
    assert ("--salvage" in printed.err) == (not flags)
    read = read_back(path)
    assert read_back(tmp_path / "out.mcap").messages == read.messages
    assert read.count() == 598


def test_damaged_rosbag1_is_salvaged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_bag(tmp_path / "a.bag", rows_of(600), "bz2")
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 40] = bytes(40)
    path.write_bytes(content)
    readable = len(read_rows(path).rows)

    status = crosscue(
        ["convert", str(path), "-o", str(tmp_path / "out.mcap"), "--salvage", "--json"]
    )

    account = json.loads(capsys.readouterr().out)
    assert status == 3
    assert 0 < readable < 600
    # The random payloads fit no schema, so each message read is found and then dropped.
    assert (
        sum(
            one["found"] + one["dropped"].get("does not fit its schema", 0)
            for one in account["topics"].values()
        )
        == readable
    )


@pytest.mark.parametrize("command", ["info", "convert"])
def test_chunk_over_max_chunk_is_refused_with_limit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(McapFile(sound_parts("zstd", is_chunked=True)).coded())
    out = {
        "info": [],
        "convert": ["-o", str(tmp_path / "o.mcap")],
        "decode": ["-o", str(tmp_path / "t")],
    }

    status = crosscue([command, str(path), "--max-chunk", "0.001", *out[command]])

    printed = capsys.readouterr()
    text = " ".join((printed.out + printed.err).split())
    # A log with no chunk below the limit has nothing to convert.
    assert status == (3 if command == "info" else 4)
    assert "the limit is 1048" in text
