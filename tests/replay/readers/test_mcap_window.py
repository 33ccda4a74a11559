"""A part of an MCAP log: the same rows as from a complete pass, with only the part read."""

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import crosscue
from crosscue.replay.base import Selection
from crosscue.replay.readers.mcap import recording_pass as mcap_pass
from support.mcap_files import (
    ChunkOf,
    McapFile,
    Reading,
    attachment,
    channel,
    message,
    read_back,
    read_coded,
    schema,
)
from support.trees import written

TOPICS = 4
DEFINITIONS = [schema(1), *(channel(i, 1, f"/t{i}") for i in range(TOPICS))]
BEYOND_INT64 = 1 << 63
TIMES = st.integers(0, 60) | st.sampled_from([BEYOND_INT64 - 1, BEYOND_INT64, (1 << 64) - 1])
ROWS = st.lists(st.tuples(st.integers(0, TOPICS - 1), TIMES, st.binary(max_size=20)), max_size=8)
TOPIC_SETS = st.none() | st.frozensets(st.sampled_from(["/t0", "/t1", "/t2", "/t3", "/none"]))
BOUND = st.none() | st.integers(-5, 70) | st.just(BEYOND_INT64)


def read_by_complete_pass(path: Path, selection: Selection) -> Reading:
    """Read the part by a complete pass over all chunks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mcap_pass, "find_window", lambda *_: "a test")
        return read_back(path, selection)


@st.composite
def files(draw: st.DrawFn) -> McapFile:
    """Draw chunks that overlap in time, some without message index, and messages between them."""
    parts: list[bytes | ChunkOf] = [*DEFINITIONS]
    for _ in range(draw(st.integers(0, 8))):
        rows = [message(*row) for row in draw(ROWS)]
        kind = draw(st.sampled_from(["chunk", "chunk", "chunk", "bare", "attachment"]))
        if kind == "chunk":
            compression = draw(st.sampled_from(["", "lz4", "zstd"]))
            parts.append(ChunkOf(rows, compression, is_indexed=draw(st.integers(0, 3)) > 0))
        elif kind == "bare":
            parts += rows
        else:
            parts.append(attachment("a", b"body"))
    return McapFile(parts, draw(st.booleans()), summary_crc=draw(st.integers(0, 3)) > 0)


@pytest.mark.slow
@settings(max_examples=120)
@given(file=files(), selection=st.builds(Selection, TOPIC_SETS, BOUND, BOUND))
def test_selection_yields_same_rows_as_complete_pass(
    tmp_path: Path, file: McapFile, selection: Selection
) -> None:
    path = written(tmp_path / "log.mcap", file.coded())

    ours, whole = read_back(path, selection), read_by_complete_pass(path, selection)

    assert ours.messages == whole.messages
    assert ours.ledger.accounts == whole.ledger.accounts
    assert ours.ledger.is_whole
    assert ours.adds_up()


def chunk(k: int, topic: int = 0, times: tuple[int, int] | None = None) -> ChunkOf:
    rows = [message(topic, 100 * k + i, b"%d" % i) for i in range(10)]
    return ChunkOf(rows, "zstd", times=times)


def write_with_destroyed_chunks(
    path: Path, is_kept: Callable[[int], bool], chunks: list[ChunkOf]
) -> None:
    """Write ``chunks`` to a file, with all except those kept overwritten."""
    coded = bytearray(McapFile([*DEFINITIONS, *chunks]).coded())
    for k, one in enumerate(chunks):
        if not is_kept(k):
            body = one.coded()
            at = coded.index(body)
            coded[at : at + len(body)] = b"\xff" * len(body)
    path.write_bytes(coded)


def test_chunks_outside_time_range_are_not_read(tmp_path: Path) -> None:
    write_with_destroyed_chunks(
        tmp_path / "x.mcap", lambda k: k in (3, 4), [chunk(k) for k in range(9)]
    )

    reading = read_back(tmp_path / "x.mcap", Selection(None, 305, 405))

    assert [log for log, _, _ in reading.messages["/t0"]] == [*range(305, 310), *range(400, 405)]
    assert reading.ledger.is_whole
    assert reading.ledger.accounts["/t0"].skipped == {"outside --from/--to": 80}
    assert reading.ledger.integrity == (
        "CRC-32 verified: the summary; of 9 chunks 2 were read and verified; the rest was not"
    )


def test_seconds_after_start_need_no_chunk_but_those_of_the_part(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    write_with_destroyed_chunks(path, lambda k: k in (3, 4), [chunk(k) for k in range(1, 9)])

    with crosscue.open(path) as log:
        part = log.part(300e-9, 405e-9).selection
        reading = read_back(path, part)

    assert part == Selection(None, 400, 505)
    assert reading.ledger.is_whole


@pytest.mark.parametrize("case", ["no checksum", "times not set", "message before"])
def test_start_that_the_summary_does_not_state_is_that_of_the_first_row(
    case: str, tmp_path: Path
) -> None:
    chunks: list[bytes | ChunkOf] = [chunk(k, times=(0, 0)) for k in (1, 2)]
    first = [message(0, 50, b"")] if case == "message before" else []
    if case != "times not set":
        chunks = [chunk(1), chunk(2)]
    path = tmp_path / "x.mcap"
    file = McapFile([*DEFINITIONS, *first, *chunks], summary_crc=case != "no checksum")
    path.write_bytes(file.coded())

    with crosscue.open(path) as log:
        part = log.part(0.0).selection

    assert part.start_ns == (50 if first else 100)


def test_wrong_time_in_index_without_checksum_is_detected(tmp_path: Path) -> None:
    coded = McapFile([*DEFINITIONS, *map(chunk, range(9))], summary_crc=False).coded()
    at = coded.rindex(struct.pack("<QQ", 400, 409))
    coded = coded[:at] + struct.pack("<QQ", 400, 404) + coded[at + 16 :]
    reading = read_coded(tmp_path, coded, Selection(None, 405, 505))

    assert [m[0] for m in reading.messages["/t0"]] == [*range(405, 410), *range(500, 505)]
    assert any("does not match the chunk" in notice for notice in reading.ledger.notices)


def test_inconsistent_message_counts_are_reported(tmp_path: Path) -> None:
    file = McapFile([*DEFINITIONS, *map(chunk, range(9))], summary_crc=False)
    counts = struct.pack("<HQ", 0, 90)
    before, _, after = file.coded().rpartition(counts)
    coded = before + struct.pack("<HQ", 0, 91) + after
    reading = read_coded(tmp_path, coded, Selection(None, 400, 405))

    assert any("do not add up" in notice for notice in reading.ledger.notices)
    assert reading.ledger.accounts["/t0"].dropped.total() == 1
