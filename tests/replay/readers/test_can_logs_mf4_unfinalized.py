"""MDF 4 logs that are unfinalized, unsorted, truncated, or have virtual channels."""

import random
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crosscue.replay.columns import CanFrames
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
from support.can_files import Sent, by_bus, random_frames, read_back
from support.data import shared
from support.mf4_files import unsorted

asammdf = pytest.importorskip("asammdf")

Key = tuple[int, int, bool, bool]
# Seconds, data lengths and payloads by bus, identifier, format of the identifier and direction.
Frames = dict[Key, list[tuple[float, int, bytes]]]

REAL = [
    (("css_unfinalized", "00000000_00000048_00000001.MF4"), {1: 1_026}),
    (("css_unfinalized", "17BD1DB7_00000006_00000170.MF4"), {1: 2_010}),
    (("css_unfinalized", "94C49784_00000005_00000002.MF4"), {1: 9_600}),
    (("css_unfinalized", "FCBF0606_00002058_00000001-5FAB8E54.mf4"), {1: 17_674}),
    (("css_unfinalized", "00000014.MF4"), {1: 14_360, 2: 14_361}),
    (("css_unfinalized", "00000014_fin.MF4"), {1: 14_360, 2: 14_361}),
    (("css_unfinalized", "asammdf-basics_00000001.MF4"), {1: 139_136, 9: 11_275}),
    (("css_unfinalized", "7512BE4D_00000427_00000001.MF4"), {1: 15_302, 9: 56_707}),
    (("css_canedge", "3BA199E2", "00000164", "00000001-60FE3F04.MF4"), {1: 7_692, 2: 57_604}),
]


def _read_with_asammdf(path: Path) -> Frames:
    """Read the data frames with asammdf after it has finalized the file."""
    found: Frames = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with asammdf.MDF(path) as mdf:
            for k, group in enumerate(mdf.groups):
                names = {channel.name for channel in group.channels}
                if "CAN_DataFrame.ID" in names and group.channel_group.cycles_nr:
                    _add_group(mdf, k, names, found)
    return found


def _add_group(mdf: Any, group: int, names: set[str], found: Frames) -> None:
    part = {
        name: mdf.get(f"CAN_DataFrame.{name}", group=group)
        for name in ("BusChannel", "ID", "IDE", "Dir", "DataLength", "DataBytes")
        if f"CAN_DataFrame.{name}" in names
    }
    length = part["DataLength"].samples.astype(int).tolist()
    seconds = part["ID"].timestamps.tolist()
    columns = [part[n].samples.astype(int).tolist() for n in ("BusChannel", "ID", "IDE", "Dir")]
    for k, (bus, number, ide, direction) in enumerate(zip(*columns, strict=True)):
        payload = part["DataBytes"].samples[k].tobytes()[: length[k]]
        key = (bus, number & 0x1FFFFFFF, bool(ide), bool(direction))
        found.setdefault(key, []).append((seconds[k], length[k], payload))


def _read_with_crosscue(path: Path, start_ns: int) -> tuple[Frames, Ledger]:
    ledger = Ledger(str(path))
    found: Frames = {}
    with open_log(path) as log:
        for block in log.read(ledger):
            rows = block.rows
            assert isinstance(rows, CanFrames)
            assert rows.is_tx is not None
            bus = int(block.topic.removeprefix("can/"))
            columns = zip(
                rows.arbitration_id.tolist(),
                rows.is_extended.tolist(),
                rows.is_tx.tolist(),
                rows.length.tolist(),
                ((block.log_ns - start_ns) * 1e-9).tolist(),
                strict=True,
            )
            for k, (number, ide, is_tx, length, seconds) in enumerate(columns):
                payload = rows.data[k].tobytes()[:length]
                found.setdefault((bus, number, ide, is_tx), []).append((seconds, length, payload))
    return found, ledger


def _assert_same_frames(ours: Frames, theirs: Frames) -> None:
    assert {key: len(rows) for key, rows in ours.items()} == {
        key: len(rows) for key, rows in theirs.items()
    }
    for key, rows in ours.items():
        assert [row[1:] for row in rows] == [row[1:] for row in theirs[key]], key
        ours_s, theirs_s = np.array([r[0] for r in rows]), np.array([r[0] for r in theirs[key]])
        np.testing.assert_allclose(ours_s, theirs_s, rtol=0, atol=1e-6)


def _start_ns(path: Path) -> int:
    return int.from_bytes(path.read_bytes()[64 + 24 + 48 :][:8], "little")


@pytest.mark.slow
@pytest.mark.parametrize(("where", "expected"), REAL, ids=[where[-1] for where, _ in REAL])
def test_real_unfinalized_log_matches_asammdf_after_finalizing(
    where: tuple[str, ...], expected: dict[int, int]
) -> None:
    path = shared("can", *where)

    ours, ledger = _read_with_crosscue(path, _start_ns(path))

    by_number: dict[int, int] = {}
    for (bus, *_), rows in ours.items():
        by_number[bus] = by_number.get(bus, 0) + len(rows)
    assert by_number == expected
    assert ledger.is_whole
    _assert_same_frames(ours, _read_with_asammdf(path))


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
    path = tmp_path / "x.mf4"
    path.write_bytes(unsorted(frames, **options).content)

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
