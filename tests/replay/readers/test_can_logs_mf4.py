"""MDF 4 logs: bus logging and signals, compared with python-can and asammdf."""

import random
import warnings
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import Table
from crosscue.replay.errors import CrosscueError
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.logs.opening import open_log
from crosscue.replay.readers.mf4.blocks import Blocks
from support.can_files import assert_equal_to_python_can, random_frames, read_back
from support.data import shared
from support.every_format import mf4

asammdf = pytest.importorskip("asammdf")
REAL = ("can", "css_canedge", "3BA199E2", "00000164", "00000001-60FE3F04.MF4")


def _two_groups(path: Path) -> Path:
    """Write a log with two groups of signals, of 1000 and of 10 rows."""
    with asammdf.MDF(version="4.10") as mdf:
        for count in (1000, 10):
            signal = asammdf.Signal(np.arange(count), np.arange(count) * 0.01, name="speed")
            mdf.append([signal], acq_name="drive")
        mdf.save(path)
    return path


def _tables(path: Path, selection: Selection = EVERYTHING) -> tuple[dict[str, list[Any]], Ledger]:
    ledger = Ledger(str(path))
    found: dict[str, list[Any]] = {}
    with open_log(path) as log:
        for block in log.read(ledger, selection):
            found.setdefault(block.topic, []).append(block)
    return found, ledger


def test_signals_of_all_data_types_match_asammdf_input(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    times = np.arange(500) * 1e-3
    path = tmp_path / "x.mf4"
    types = ("u1", "i1", "<u2", ">u2", "<i4", ">i4", "<u8", ">i8", "<f4", ">f8", "<f8")
    samples = {t: rng.integers(0, 256, 500 * np.dtype(t).itemsize, np.uint8).view(t) for t in types}
    samples = {t: np.nan_to_num(s) if "f" in t else s for t, s in samples.items()}
    with asammdf.MDF(version="4.10") as mdf:
        mdf.append([asammdf.Signal(s, times, name=t) for t, s in samples.items()])
        mdf.save(path)

    found, _ = _tables(path)

    (blocks,) = found.values()
    for name, expected in samples.items():
        np.testing.assert_array_equal(blocks[0].rows[name], expected)


def _read_with_python_can(path: Path) -> list[can.Message]:
    """Read a log with python-can, whose warnings about omitted data are ignored."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with can.MF4Reader(path) as reader:
            return list(reader)


@pytest.mark.parametrize("compression", [0, 2])
def test_bus_logs_match_python_can(tmp_path: Path, compression: int) -> None:
    frames = [f for f in random_frames(500) if f.kind == 0]
    path = mf4(tmp_path / "x.mf4", frames, compression)
    assert_equal_to_python_can(path, _read_with_python_can(path), "can/{}", within_ns=2_000)


def test_unselected_rows_are_counted_but_not_read(tmp_path: Path) -> None:
    path = _two_groups(tmp_path / "x.mf4")
    everything, _ = _tables(path)
    times = everything["drive"][0].log_ns

    found, ledger = _tables(path, Selection(frozenset({"drive"}), int(times[10]), int(times[20])))

    assert [len(block) for block in found["drive"]] == [10]
    assert ledger.topic("drive").found == 1000
    assert ledger.topic("drive (2)").skipped.total() == 10


def _frames_of_cut(path: Path, content: bytes, at: int) -> tuple[int, bool] | None:
    path.write_bytes(content[:at])
    try:
        open_log(path).close()
    except CrosscueError as refused:
        message = str(refused)
    else:
        found, ledger = read_back(path)
        return sum(map(len, found.values())), ledger.is_whole
    assert "\n" not in message
    return None


def test_truncation_of_real_log_is_reported(tmp_path: Path) -> None:
    content = shared(*REAL).read_bytes()
    for at in range(5_000, len(content) - 1, len(content) // 12):
        outcome = _frames_of_cut(tmp_path / "x.mf4", content, at)
        if outcome is not None and outcome[0] < 65_296:
            assert not outcome[1]


@pytest.mark.parametrize("compression", [0, 2])
def test_damage_raises_only_crosscue_errors(tmp_path: Path, compression: int) -> None:
    content = mf4(tmp_path / "whole.mf4", random_frames(200), compression).read_bytes()
    path = tmp_path / "x.mf4"
    for seed in range(150):
        chance = random.Random(seed)
        at = chance.randrange(len(content) if seed % 2 else 6_000)
        count = chance.randrange(1, 65)
        patch = chance.randbytes(count) if seed % 3 else bytes(count)
        path.write_bytes((content[:at] + patch + content[at + count :])[: len(content)])
        try:
            open_log(path, Limits(chunk_bytes=1 << 22)).close()
        except CrosscueError as refused:
            message = str(refused)
        else:
            _tables(path)
            continue
        assert "\n" not in message
        assert "x.mf4" in message


@pytest.mark.parametrize("compression", [0, 2])
def test_time_range_reads_only_overlapping_blocks(
    tmp_path: Path, compression: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(3)
    count = 400_000
    times = np.arange(count) * 1e-3
    samples = [rng.integers(0, 1 << 60, count) for _ in range(3)]
    path = tmp_path / "x.mf4"
    with asammdf.MDF(version="4.10") as mdf:
        mdf.configure(write_fragment_size=1 << 18)
        signals = [asammdf.Signal(s, times, name=f"s{k}") for k, s in enumerate(samples)]
        mdf.append(signals, acq_name="drive")
        mdf.save(path, compression=compression)
    read: list[int] = []
    plain = Blocks.read

    def counted(self: Blocks, at: int, size: int) -> bytes:
        read.append(size)
        return plain(self, at, size)

    monkeypatch.setattr(Blocks, "read", counted)
    with open_log(path) as log:
        ledger = Ledger(str(path))
        first_ns = next(log.read(ledger)).log_ns[0]
        read.clear()
        span = Selection(None, int(first_ns) + 200 * 10**9, int(first_ns) + 202 * 10**9)
        ledger = Ledger(str(path))
        blocks = list(log.read(ledger, span))

    (block,) = blocks
    assert isinstance(block.rows, Table)
    np.testing.assert_array_equal(block.rows["s1"], samples[1][200_000:202_000])
    assert sum(read) < path.stat().st_size / (4 if compression else 30)
    account = ledger.topic("drive")
    assert account.declared == account.found == count
    assert account.skipped.total() == count - 2_000
    assert ledger.is_whole
    assert "of other times, were not read" in ledger.integrity


@pytest.mark.slow
def test_time_range_of_bus_log_equals_filtered_complete_pass() -> None:
    path = shared(*REAL)
    whole, _ = read_back(path)
    times = sorted(f.t_ns for frames in whole.values() for f in frames)
    for begin, end in ((0.5, 0.51), (0.0, 0.1), (0.98, 1.0), (0.3, 0.3)):
        start_ns, end_ns = times[int(begin * len(times))], times[int(end * (len(times) - 1))]

        part, ledger = read_back(path, Selection(None, start_ns, end_ns))

        expected = {
            name: [f for f in frames if start_ns <= f.t_ns < end_ns]
            for name, frames in whole.items()
        }
        assert part == {name: frames for name, frames in expected.items() if frames}
        assert ledger.is_whole
        assert sum(account.found for account in ledger.accounts.values()) == len(times)
