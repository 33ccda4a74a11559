"""CAN logs: every format's frames, and Vector BLF with its containers and hostile files."""

import struct
from dataclasses import replace
from pathlib import Path

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.base import Selection
from crosscue.replay.columns import ERROR
from crosscue.replay.ledger import NOT_ASKED_TIME
from support.can_files import (
    KINDS,
    START_NS,
    Kind,
    Sent,
    assert_equal_to_python_can,
    blf,
    by_bus,
    damaged,
    judge,
    python_can_message,
    random_frames,
    read_back,
)
from support.data import shared
from support.trees import written


def _log(folder: Path, content: bytes, suffix: str = ".blf") -> Path:
    return written(folder / f"x{suffix}", content)


def _read_with_python_can(path: Path) -> list[can.Message]:
    """Read a log with python-can, which counts channels from 0."""
    peer = list(can.BLFReader(path))
    for message in peer:
        assert isinstance(message.channel, int)
        message.channel += 1
    return peer


def test_log_written_by_python_can_matches_its_reader(tmp_path: Path) -> None:
    path = tmp_path / "x.blf"
    with can.BLFWriter(path) as writer:
        for k, frame in enumerate(random_frames(3000)):
            sent = replace(frame, bus=str(int(frame.bus) - 1))
            if k % 100 == 7:
                sent = replace(sent, kind=ERROR, payload=frame.payload[:8], is_fd=False)
            writer(python_can_message(sent))
    assert_equal_to_python_can(path, _read_with_python_can(path))


MINUTE_FRAMES = [
    replace(f, t_ns=START_NS + k * 10_000_000) for k, f in enumerate(random_frames(6_000))
]
MINUTE_LOG = blf(MINUTE_FRAMES, container=4_000)


@pytest.mark.slow
@given(
    window=st.tuples(st.integers(-5, 65), st.integers(-5, 65)),
    ends=st.sampled_from(["both", "from", "to"]),
    stored=st.booleans(),
)
@settings(max_examples=20)
def test_time_range_yields_exact_frames_and_account(
    tmp_path: Path, window: tuple[int, int], ends: str, stored: bool
) -> None:
    start_ns, end_ns = (START_NS + s * 10**9 for s in sorted(window))
    start_ns, end_ns = (0 if ends == "to" else start_ns), (1 << 62 if ends == "from" else end_ns)
    selection = Selection(None, start_ns or None, None if ends == "from" else end_ns)
    content = blf(MINUTE_FRAMES, container=4_000, stored=stored) if stored else MINUTE_LOG

    found, ledger = read_back(_log(tmp_path, content), selection)

    wanted = [f for f in MINUTE_FRAMES if start_ns <= f.t_ns < end_ns]
    assert found == by_bus(wanted)
    accounts = ledger.accounts.values()
    assert sum(one.in_file for one in accounts) == len(MINUTE_FRAMES)
    assert sum(one.used for one in accounts) == len(wanted)
    assert {reason for one in accounts for reason in one.skipped} <= {NOT_ASKED_TIME}
    assert ledger.is_whole


def test_damage_inside_time_range_is_reported(tmp_path: Path) -> None:
    content = bytearray(MINUTE_LOG)
    content[content.find(b"LOBJ", len(content) * 51 // 60) + 1_500] ^= 0xFF
    window = Selection(start_ns=START_NS + 45 * 10**9, end_ns=START_NS + 58 * 10**9)

    found, ledger = read_back(_log(tmp_path, bytes(content)), window)

    assert sum(map(len, found.values())) < 1_300
    assert "container does not match its checksum" in ledger.topic("").dropped_unknown


@pytest.mark.parametrize("step", range(500, 548))
def test_read_buffer_may_end_anywhere_in_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    monkeypatch.setattr("crosscue.replay.readers.blf.reader.STREAM_BYTES", step)
    frames = random_frames(100)

    found, ledger = read_back(_log(tmp_path, blf(frames, container=4_000)))

    assert found == by_bus(frames)
    assert ledger.is_whole


@given(deleted=st.sets(st.integers(0, 79)))
@settings(max_examples=25)
def test_every_deleted_object_is_reported_as_dropped(tmp_path: Path, deleted: set[int]) -> None:
    frames = random_frames(80)
    kept = [frame for k, frame in enumerate(frames) if k not in deleted]
    content = blf(kept)[:32] + struct.pack("<L", len(frames)) + blf(kept)[36:]

    found, ledger = read_back(_log(tmp_path, content))

    assert found == by_bus(kept)
    assert ledger.topic("").dropped.total() == len(deleted)
    assert ledger.is_whole == (not deleted)


def test_object_signature_inside_payload_is_ignored(tmp_path: Path) -> None:
    frames = [Sent(f.t_ns, f.bus, 0x7, b"xLOBJabc", False) for f in random_frames(20)]

    found, ledger = read_back(_log(tmp_path, blf(frames, container=333)))

    assert found == by_bus(frames)
    assert ledger.is_whole


def test_invalid_containers_after_frames_are_reported(tmp_path: Path) -> None:
    false = struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, 0xFFFF, 10, 2, 0xFFFF)
    nested = struct.pack("<4sHHLL", b"LOBJ", 16, 1, 8, 10)

    for junk in (false * 20_000, nested * 20_000, b"LOBJ" * 100_000):
        found, ledger = read_back(_log(tmp_path, blf(random_frames(30)) + junk))

        assert sum(map(len, found.values())) == 30
        assert not ledger.is_whole


def test_real_log_matches_python_can() -> None:
    path = shared("can", "python_can", "issue_1905.blf")
    assert_equal_to_python_can(path, _read_with_python_can(path))


EVERY_KIND = pytest.mark.parametrize("kind", KINDS.values(), ids=list(KINDS))


@EVERY_KIND
@given(seed=st.integers(0, 2**31))
@settings(max_examples=5)
def test_frames_survive_write_and_read(tmp_path: Path, kind: Kind, seed: int) -> None:
    frames = kind.frames(300, seed)
    path = _log(tmp_path, kind.spell(frames), kind.suffix)

    found, ledger = read_back(path)

    assert found == kind.expected(frames)
    assert ledger.is_whole == (kind is not KINDS["blf-unclosed"])
    assert ledger.integrity != "not checked"


@pytest.mark.slow
@EVERY_KIND
def test_damage_adds_no_frames_and_hides_no_loss(tmp_path: Path, kind: Kind) -> None:
    frames = kind.frames(60)
    content = kind.spell(frames)
    path = tmp_path / f"x{kind.suffix}"
    copies = {f"cut at {at}": content[:at] for at in range(1, len(content), len(content) // 120)}
    copies |= {f"seed {seed}": damaged(content, seed) for seed in range(120)}
    for how, copy in copies.items():
        verdict = judge(kind, frames, content, copy, path)

        assert not verdict.is_fault, f"{how}: {verdict}"
