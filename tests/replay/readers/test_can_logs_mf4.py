"""MDF 4 logs: bus logging and signals, finalized or not, compared with python-can and asammdf."""

import random
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from crosscue.replay.base import Selection
from crosscue.replay.columns import CanFrames, Table
from crosscue.replay.errors import CrosscueError
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.logs.opening import open_log
from crosscue.replay.readers.mf4.blocks import Blocks
from support.accounted import read, read_topics
from support.can_files import Sent, assert_equal_to_python_can, by_bus, random_frames, read_back
from support.data import shared
from support.every_format import mf4
from support.mf4_files import unsorted
from support.trees import written

asammdf = pytest.importorskip("asammdf")
REAL = ("can", "css_canedge", "3BA199E2", "00000164", "00000001-60FE3F04.MF4")


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

    found, _ = read_topics(path)

    ((block,),) = found.values()
    assert isinstance(block.rows, Table)
    for name, expected in samples.items():
        np.testing.assert_array_equal(block.rows[name], expected)


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
    assert_equal_to_python_can(path, _read_with_python_can(path), within_ns=2_000)


def test_unselected_rows_are_counted_but_not_read(tmp_path: Path) -> None:
    path = tmp_path / "x.mf4"
    with asammdf.MDF(version="4.10") as mdf:
        for count in (1000, 10):
            signal = asammdf.Signal(np.arange(count), np.arange(count) * 0.01, name="speed")
            mdf.append([signal], acq_name="drive")
        mdf.save(path)
    everything, _ = read_topics(path)
    times = everything["drive"][0].log_ns

    found, ledger = read_topics(
        path, Selection(frozenset({"drive"}), int(times[10]), int(times[20]))
    )

    assert [len(block) for block in found["drive"]] == [10]
    assert ledger.topic("drive").found == 1000
    assert ledger.topic("drive (2)").skipped.total() == 10


def test_truncation_of_real_log_is_reported(tmp_path: Path) -> None:
    content = shared(*REAL).read_bytes()
    path = tmp_path / "x.mf4"
    for at in range(5_000, len(content) - 1, len(content) // 12):
        path.write_bytes(content[:at])
        try:
            blocks, ledger = read(path)
        except CrosscueError as refused:
            assert "\n" not in str(refused)  # noqa: PT017
            continue
        assert not ledger.is_whole or sum(map(len, blocks)) == 65_296


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
            read(path)
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


UNFINALIZED = [
    (("css_unfinalized", "00000000_00000048_00000001.MF4"), {1: 1_026}),
    (("css_unfinalized", "17BD1DB7_00000006_00000170.MF4"), {1: 2_010}),
    (("css_unfinalized", "94C49784_00000005_00000002.MF4"), {1: 9_600}),
    (("css_unfinalized", "FCBF0606_00002058_00000001-5FAB8E54.mf4"), {1: 17_674}),
    (("css_unfinalized", "00000014.MF4"), {1: 14_360, 2: 14_361}),
    (("css_unfinalized", "00000014_fin.MF4"), {1: 14_360, 2: 14_361}),
    (("css_unfinalized", "asammdf-basics_00000001.MF4"), {1: 139_136, 9: 11_275}),
    (("css_unfinalized", "7512BE4D_00000427_00000001.MF4"), {1: 15_302, 9: 56_707}),
    (REAL[1:], {1: 7_692, 2: 57_604}),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("where", "expected"), UNFINALIZED, ids=[where[-1] for where, _ in UNFINALIZED]
)
def test_real_unfinalized_log_matches_python_can(
    where: tuple[str, ...], expected: dict[int, int]
) -> None:
    path = shared("can", *where)
    theirs = _read_with_python_can(path)

    assert_equal_to_python_can(path, theirs, within_ns=1_000, by_id=True)

    assert Counter(message.channel for message in theirs) == expected
    rows = [block.rows for block in read(path)[0]]
    sent = [one.is_tx for one in rows if isinstance(one, CanFrames) and one.is_tx is not None]
    assert np.concatenate(sent).sum() == sum(not message.is_rx for message in theirs)


VARIANTS: dict[str, dict[str, Any]] = {
    "one group": {"virtual": False},
    "virtual": {"virtual": True},
    "identifiers of 2 bytes": {"virtual": True, "id_bytes": 2},
    "identifiers of 4 bytes": {"virtual": False, "id_bytes": 4},
    "identifiers of 8 bytes": {"virtual": True, "id_bytes": 8},
    "values before their records": {"virtual": False, "order": "before"},
    "values after all records": {"virtual": False, "order": "last"},
    "values of some groups after all records": {"virtual": True, "order": "last"},
    "offsets never written": {"virtual": False, "flags": 0x65},
    "list of blocks": {"virtual": True, "stretch": 999, "flags": 0x21},
    "list with its last blocks missing": {"virtual": False, "stretch": 999, "flags": 0x35},
    "deflated": {"virtual": False, "stretch": 999, "coding": 0, "flags": 0x21},
    "transposed": {"virtual": True, "stretch": 999, "coding": 1, "flags": 0x21},
    "deflated, last blocks missing": {"virtual": True, "stretch": 999, "coding": 0, "flags": 0x31},
    "finalized": {"virtual": True, "is_finalized": True},
    "finalized, one group": {"virtual": False, "is_finalized": True},
}


def _frames(count: int, seed: int = 1, *, virtual: bool) -> list[Sent]:
    """Return frames for a log; the older layout contains only data frames."""
    return [f for f in random_frames(count, seed) if virtual or f.kind == 0]


@pytest.mark.parametrize("variant", VARIANTS)
def test_all_layouts_of_channel_groups_yield_every_frame(tmp_path: Path, variant: str) -> None:
    options = VARIANTS[variant]
    frames = _frames(1_500, virtual=options["virtual"])
    path = written(tmp_path / "x.mf4", unsorted(frames, **options).content)

    found, ledger = read_back(path)

    assert found == by_bus(frames, "can/{}")
    assert ledger.is_whole
    notice = f"not finalized by the logger; {len(frames)} records recovered from the data block"
    assert (notice in ledger.notices) != options.get("is_finalized", False)


@pytest.mark.slow
@pytest.mark.parametrize("order", ["after", "before", "last"])
@pytest.mark.parametrize("virtual", [False, True])
def test_truncation_drops_only_frames_after_it(tmp_path: Path, virtual: bool, order: str) -> None:
    frames = _frames(120, seed=3, virtual=virtual)
    whole = unsorted(frames, virtual=virtual, order=order)
    path = tmp_path / "x.mf4"
    chance = random.Random(7)
    for cut in sorted(chance.sample(range(whole.data_at, len(whole.content)), 120)):
        path.write_bytes(whole.content[:cut])
        inside = [f for f, end in zip(frames, whole.ends, strict=True) if end <= cut]

        found, ledger = read_back(path)

        assert found == by_bus(inside, "can/{}"), f"cut at {cut}"
        if cut not in whole.starts:
            assert not ledger.is_whole, f"cut at {cut}: no loss reported"
        known = sum(account.dropped.total() for account in ledger.accounts.values())
        assert known <= len(frames) - len(inside) + 1


CUT_UNSEEN = "not finalized: a cut between two records cannot be detected"


@pytest.mark.parametrize("variant", ["one group", "virtual", "identifiers of 2 bytes"])
def test_cut_between_records_of_unfinalized_log_is_disclosed_as_undetectable(
    tmp_path: Path, variant: str
) -> None:
    options = VARIANTS[variant]
    whole = unsorted(_frames(100, virtual=options["virtual"]), **options)
    path = tmp_path / "x.mf4"
    for end in (len(whole.content), whole.starts[60]):
        path.write_bytes(whole.content[:end])
        _, ledger = read_back(path)
        assert ledger.is_whole
        assert CUT_UNSEEN in ledger.integrity

    path.write_bytes(unsorted(_frames(100, virtual=True), virtual=True, is_finalized=True).content)
    assert CUT_UNSEEN not in read_back(path)[1].integrity


@pytest.mark.parametrize("virtual", [False, True])
def test_unknown_record_identifier_is_reported_and_adds_no_frames(
    tmp_path: Path, virtual: bool
) -> None:
    frames = _frames(100, virtual=virtual)
    whole = unsorted(frames, virtual=virtual)
    path = tmp_path / "x.mf4"
    for k in (0, 17, 60):
        content = bytearray(whole.content)
        content[whole.starts[k]] = 0xEE
        path.write_bytes(content)

        found, ledger = read_back(path)

        inside = [f for f, e in zip(frames, whole.ends, strict=True) if e <= whole.starts[k]]
        assert found == by_bus(inside, "can/{}")
        assert not ledger.is_whole
        assert any("unknown record identifier 238" in drop.detail for drop in ledger.drops())
