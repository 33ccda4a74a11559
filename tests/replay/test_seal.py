"""Seals: a changed byte is detected and located in every format by every reader."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import asammdf
import numpy as np
import pytest

from crosscue.eval.cli import run
from crosscue.eval.fit.log_images import log_span
from crosscue.eval.runs.stored_images import StoredCamera, read_pictures
from crosscue.replay.base import Selection
from crosscue.replay.clocks.clock import Clock
from crosscue.replay.errors import LogError
from crosscue.replay.formats import FORMATS
from crosscue.replay.ledger import CHANGED, DIFFERS, Ledger
from crosscue.replay.limits import MIB
from crosscue.replay.logs.opening import open_log
from crosscue.replay.losses import losses_heard
from crosscue.replay.seal import seal as sealing
from crosscue.replay.seal.seal import digests_of, read_seal, seal_path
from support.accounted import read
from support.can_files import blf, candump, random_frames
from support.every_format import EVERY_FORMAT
from support.pictures import picture_folder
from support.rosbag_files import rows_of, write_bag, write_folder


def _sealed(folder: Path, kind: str) -> Path:
    log = EVERY_FORMAT[kind](folder)
    assert run(["seal", str(log)]) == 0
    return log


def _files(log: Path) -> list[Path]:
    if log.is_dir():
        return sorted(path for path in log.rglob("*") if path.is_file())
    return [log]


def _flip(path: Path, at: int) -> None:
    with path.open("r+b") as file:
        file.seek(at)
        (byte,) = file.read(1)
        file.seek(at)
        file.write(bytes([byte ^ 0x10]))


def _losses_text(log: Path) -> str:
    """Return all losses that reading a log reports."""
    try:
        _, ledger = read(log)
    except LogError as error:
        return str(error)
    assert not ledger.is_whole
    return "; ".join(detail.detail for detail in ledger.drops())


@pytest.fixture
def long_log(tmp_path: Path) -> Path:
    """Write and seal a candump log of more than three blocks."""
    log = tmp_path / "can.log"
    log.write_bytes(candump(random_frames(300)) * 300)
    assert log.stat().st_size > 3 * MIB
    assert run(["seal", str(log)]) == 0
    return log


def test_every_format_has_a_sample_log() -> None:
    assert set(EVERY_FORMAT) == set(FORMATS)


@pytest.mark.parametrize("kind", EVERY_FORMAT)
def test_unchanged_sealed_log_is_complete(tmp_path: Path, kind: str) -> None:
    log = EVERY_FORMAT[kind](tmp_path)
    before, _ = read(log)
    assert run(["seal", str(log)]) == 0

    after, ledger = read(log)

    assert ledger.is_whole, ledger.details
    assert "sealed at" in ledger.integrity
    assert "none differs" in ledger.integrity
    assert [len(block) for block in after] == [len(block) for block in before]
    assert run(["seal", "--check", str(log)]) == 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", EVERY_FORMAT)
def test_changed_byte_is_reported_with_its_block(
    tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log = _sealed(tmp_path, kind)
    rng = np.random.default_rng(11)
    for path in _files(log):
        size = path.stat().st_size
        name = path.relative_to(log).as_posix() if log.is_dir() else log.name
        for at in {0, size - 1, int(rng.integers(size)), int(rng.integers(size))}:
            _flip(path, at)
            assert f"{name}: bytes 0 to {size}" in _losses_text(log), (name, at)
            _flip(path, at)
    assert read(log)[1].is_whole

    _flip(path, size // 2)
    capsys.readouterr()
    status = run(["info", str(log)])
    assert status in (3, 4)
    assert "the seal" in "".join(capsys.readouterr()) or status == 4
    assert run(["seal", "--check", str(log)]) == 3
    assert f"{name}: bytes 0 to {size} differ from the seal" in capsys.readouterr().err


def test_changed_block_is_located_to_one_mib_and_still_read(long_log: Path) -> None:
    rows = sum(len(block) for block in read(long_log)[0])
    # A digit of a payload: the line remains valid, and no reader can detect it.
    at = long_log.read_bytes().index(b"#AA", 2 * MIB) + 2
    text = bytearray(long_log.read_bytes())
    text[at : at + 1] = b"B"
    long_log.write_bytes(text)

    blocks, ledger = read(long_log)

    (drop,) = ledger.drops()
    assert (drop.reason, drop.count) == (DIFFERS, None)
    assert drop.detail == f"can.log: bytes {2 * MIB} to {3 * MIB}"
    assert sum(len(block) for block in blocks) == rows
    assert "some differ" in ledger.integrity


def test_adjacent_changed_blocks_are_one_span(long_log: Path) -> None:
    for at in (5, MIB + 5, 3 * MIB + 5):
        _flip(long_log, at)

    spans = [drop.detail for drop in read(long_log)[1].drops() if drop.reason == DIFFERS]

    size = long_log.stat().st_size
    assert spans == [f"can.log: bytes 0 to {2 * MIB}", f"can.log: bytes {3 * MIB} to {size}"]


@pytest.mark.slow
def test_commands_report_changed_block_of_sealed_log(
    long_log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    at = long_log.read_bytes().index(b"#", MIB) + 2
    _flip(long_log, at)
    out = long_log.with_name("out.mcap")

    assert run(["convert", str(long_log), "-o", str(out)]) == 3
    assert f"can.log: bytes {MIB} to {2 * MIB}" in " ".join(capsys.readouterr().err.split())
    assert run(["info", str(long_log)]) == 3
    assert f"can.log: bytes {MIB} to {2 * MIB}" in " ".join(capsys.readouterr().out.split())


def test_reader_without_ledger_warns_and_command_exits_with_3(
    long_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = f"can.log: bytes {MIB} to {2 * MIB}"
    draft = ["vehicle", "init", str(long_log), "-o", str(tmp_path / "v.toml"), "--overwrite"]
    assert run(draft) == 0
    _flip(long_log, long_log.read_bytes().index(b"#AA", MIB) + 2)

    with losses_heard() as warned:
        log_span(long_log)
        log_span(long_log)
    assert sum(where in loss for loss in warned) == 1
    assert run(draft) == 3
    assert where in capsys.readouterr().err


def test_stored_pictures_are_checked_against_seal(tmp_path: Path) -> None:
    log = picture_folder(tmp_path / "front", 12, "rate_hz: 10\n")
    assert run(["seal", str(log)]) == 0
    with open_log(log) as opened:
        (topic,) = opened.topics
    camera = StoredCamera(log, topic, Clock.LOG, Selection())
    (log / "frame_3.png").write_bytes((log / "frame_4.png").read_bytes())

    with losses_heard() as warned:
        read_pictures(camera, lambda t_ns, picture: None)

    assert warned
    assert "frame_3.png" in "".join(warned)


@pytest.mark.parametrize("is_cut", [True, False])
def test_changed_size_is_reported_in_one_line(long_log: Path, is_cut: bool) -> None:
    size = long_log.stat().st_size
    with long_log.open("r+b") as file:
        if is_cut:
            file.truncate(2 * MIB)
        else:
            file.seek(size)
            file.write(candump(random_frames(3)))

    losses = [drop for drop in read(long_log)[1].drops() if drop.reason == CHANGED]

    (drop,) = losses
    now = long_log.stat().st_size
    assert drop.detail == f"size changed: can.log ({size} bytes when sealed, now {now})"


def test_missing_and_new_files_are_reported_in_one_line_each(tmp_path: Path) -> None:
    log = picture_folder(tmp_path / "front", 12, "rate_hz: 10\n")
    assert run(["seal", str(log)]) == 0
    for number in range(5):
        (log / f"frame_{number}.png").unlink()
    (log / "frame_99.png").write_bytes((log / "frame_7.png").read_bytes())

    reported = [drop.detail for drop in read(log)[1].drops() if drop.reason == CHANGED]

    assert reported == [
        "missing: frame_0.png, frame_1.png, frame_2.png and 2 more",
        "not in the seal: frame_99.png",
    ]


def test_seal_of_changed_log_is_replaced_only_with_overwrite(
    long_log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = seal_path(long_log).read_bytes()
    assert run(["seal", str(long_log)]) == 0
    assert seal_path(long_log).read_bytes() == before

    _flip(long_log, 7)
    capsys.readouterr()
    assert run(["seal", str(long_log)]) == 1
    assert "--overwrite only if the log is correct" in capsys.readouterr().err
    assert seal_path(long_log).read_bytes() == before

    assert run(["seal", "--overwrite", str(long_log)]) == 0
    assert run(["seal", "--check", str(long_log)]) == 0


def test_info_shows_whether_log_is_sealed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = EVERY_FORMAT["candump"](tmp_path)
    for quick in ([], ["--quick"]):
        assert run(["info", str(log), *quick]) == 0
        assert "not sealed" in capsys.readouterr().out
    assert run(["seal", str(log)]) == 0
    sealed_at = read_seal(seal_path(log)).sealed_at
    capsys.readouterr()
    for quick in ([], ["--quick"]):
        assert run(["info", str(log), *quick]) == 0
        assert f"sealed at {sealed_at} (xxh3_128" in " ".join(capsys.readouterr().out.split())


def test_log_and_seal_can_be_renamed_together(tmp_path: Path) -> None:
    log = _sealed(tmp_path, "rosbag1")
    moved = log.rename(tmp_path / "other.bag")
    seal_path(log).rename(seal_path(moved))

    assert "none differs" in read(moved)[1].integrity
    _flip(moved, moved.stat().st_size // 2)
    assert "other.bag: bytes 0 to" in _losses_text(moved)


def test_time_file_of_video_is_sealed(tmp_path: Path) -> None:
    film = _sealed(tmp_path, "video")

    assert set(read_seal(seal_path(film)).files) == {".", "front.txt"}
    _flip(tmp_path / "front.txt", 30)
    assert "front.txt" in _losses_text(film)


@pytest.mark.parametrize("suffix", ["-wal", "-journal"])
def test_journal_of_sqlite_log_is_sealed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], suffix: str
) -> None:
    log = EVERY_FORMAT["rosbag2-sqlite3"](tmp_path)
    journal = log.with_name(log.name + suffix)
    journal.write_bytes(bytes(100))
    assert run(["seal", str(log)]) == 0
    assert set(read_seal(seal_path(log)).files) == {".", journal.name}
    _flip(journal, 30)
    assert run(["seal", "--check", str(log)]) == 3
    assert f"{journal.name}: bytes 0 to 100 differ from the seal" in capsys.readouterr().err


def _damaged_seals() -> Iterator[tuple[str, bytes]]:
    def entry(**changes: object) -> bytes:
        one = {"name": ".", "size": 3, "blocks": "00" * 16} | changes
        tree: dict[str, object] = {
            "kind": "crosscue seal",
            "version": 1,
            "hash": "xxh3_128",
            "block_bytes": MIB,
            "sealed_at": "2026-01-01T00:00:00Z",
            "files": [one],
        }
        from crosscue.replay.seal.seal import _own_check

        return json.dumps(tree | {"check": _own_check(tree)}).encode()

    yield "not JSON", b""
    yield "not JSON", b"\xff\x00junk"
    yield "not JSON", b"[" * 200_000
    yield "not a seal", b"[]"
    yield "not a seal", b"{}"
    yield "version 2", b'{"kind": "crosscue seal", "version": 2, "hash": "xxh3_128"}'
    yield "with hash 'md5'", b'{"kind": "crosscue seal", "version": 1, "hash": "md5"}'
    yield "own checksum", b'{"kind": "crosscue seal", "version": 1, "hash": "xxh3_128"}'
    yield "leads out of the log", entry(name="../can.log")
    yield "leads out of the log", entry(name="/etc/passwd")
    yield "leads out of the log", entry(name="a/../../b")
    yield "leads out of the log", entry(name="")
    yield "bytes of hashes for", entry(size=10**18)
    yield "bytes of hashes for", entry(size=-3)
    yield "wrong entry", entry(blocks="zz")
    yield "wrong entry", entry(name=7)
    yield "wrong entry", entry(size="3")


@pytest.mark.parametrize(("why", "content"), list(_damaged_seals()))
def test_damaged_seal_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], why: str, content: bytes
) -> None:
    log = EVERY_FORMAT["candump"](tmp_path)
    seal_path(log).write_bytes(content)

    for command in (["info"], ["seal", "--check"]):
        assert run([*command, str(log)]) == 4
        reported = capsys.readouterr().err
        assert why in reported
        assert reported.count("\n") == 1
        assert "delete it and seal the log again" in reported
    assert run(["seal", str(log)]) == 1


def test_damaged_seal_never_reports_a_different_log(tmp_path: Path) -> None:
    log = _sealed(tmp_path, "candump")
    original, original_seal = seal_path(log).read_bytes(), read_seal(seal_path(log))
    refused = 0
    for at in range(0, len(original) - 1, 7):
        text = bytearray(original)
        text[at] ^= 1
        seal_path(log).write_bytes(text)
        try:
            assert read_seal(seal_path(log)) == original_seal
        except LogError:
            refused += 1

    # Only a change of white space between tokens is harmless.
    assert refused > 0.6 * len(original) / 7


@pytest.mark.parametrize(
    ("argv", "status", "why"),
    [
        (["s3://bucket/a.bag"], 2, "a URL cannot be sealed"),
        (["can.log.seal"], 2, "is a seal itself"),
        (["gone.bag"], 4, "no such file"),
        (["--check", "can.asc"], 1, "not sealed"),
    ],
)
def test_seal_of_invalid_log_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], argv: list[str], status: int, why: str
) -> None:
    EVERY_FORMAT["asc"](tmp_path)
    words = [w if w[0] == "-" or "://" in w else str(tmp_path / w) for w in argv]

    assert run(["seal", *words]) == status
    assert why in capsys.readouterr().err


def test_convert_does_not_overwrite_a_sealed_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = EVERY_FORMAT["candump"](tmp_path)
    out = tmp_path / "out.mcap"
    assert run(["convert", str(log), "-o", str(out)]) == 0
    assert run(["seal", str(out)]) == 0
    before = out.read_bytes()

    assert run(["convert", str(log), "-o", str(out), "--overwrite"]) == 1
    assert "out.mcap.seal" in capsys.readouterr().err
    assert out.read_bytes() == before


def test_log_with_longest_file_name_is_read(tmp_path: Path) -> None:
    log = tmp_path / ("x" * 251 + ".log")
    log.write_bytes(candump(random_frames(30)))

    assert read(log)[1].is_whole


def test_hidden_files_and_circular_links_are_not_sealed(tmp_path: Path) -> None:
    log = picture_folder(tmp_path / "front", 3, "rate_hz: 10\n")
    (log / ".hidden").write_bytes(b"x")
    (log / "again").symlink_to(log)
    assert run(["seal", str(log)]) == 0

    assert set(read_seal(seal_path(log)).files) == {
        "frame_0.png",
        "frame_1.png",
        "frame_2.png",
        "timestamps.txt",
    }


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mcap", "rosbag1"])
def test_window_of_indexed_log_checks_only_its_blocks(tmp_path: Path, kind: str) -> None:
    rows = rows_of(40_000)
    if kind == "mcap":
        log = next(write_folder(tmp_path / "bag", rows, "mcap").glob("*.mcap"))
    else:
        log = write_bag(tmp_path / "log.bag", rows, chunk_bytes=300_000)
    assert log.stat().st_size > 3 * MIB
    assert run(["seal", str(log)]) == 0
    total = read_seal(seal_path(log)).blocks
    early = Selection(end_ns=rows[200].log_ns)

    def losses(selection: Selection) -> list[str]:
        ledger = Ledger(str(log))
        with open_log(log) as opened:
            for _ in opened.read(ledger, selection):
                pass
        (checked,) = re.findall(r"(\d+) of \d+ blocks|$", ledger.integrity)[:1]
        assert selection != early or 0 < int(checked) < total, ledger.integrity
        return [drop.detail for drop in ledger.drops() if drop.reason == DIFFERS]

    assert losses(early) == losses(Selection()) == []
    middle = total // 2
    _flip(log, middle * MIB + 77)
    assert losses(early) == []
    assert losses(Selection()) == [f"{log.name}: bytes {middle * MIB} to {(middle + 1) * MIB}"]
    _flip(log, middle * MIB + 77)
    at = rows[10].payload[4:20]
    _flip(log, log.read_bytes().index(at)) if at in log.read_bytes() else _flip(log, 5000)
    assert losses(early) == [f"{log.name}: bytes 0 to {MIB}"]


# Folder of the pictures of each format.
_PICTURES = {"kitti-raw": "image_02/data", "pandaset": "camera/front_camera"}


def _window_case(kind: str, folder: Path) -> tuple[Path, Selection, dict[str, bool]]:
    """Return a log, a window at its beginning, and for each of two files whether it is read."""
    if kind == "images":
        times = "".join(f"{0.5 * i:.1f}\n" for i in range(12))
        log = picture_folder(folder / "front", 12, times)
        return log, Selection(end_ns=1_000_000_000), {"frame_0.png": True, "frame_9.png": False}
    if kind in ("kitti-raw", "pandaset"):
        log = EVERY_FORMAT[kind](folder)
        place = _PICTURES[kind]
        first = min(int(block.log_ns[0]) for block in read(log)[0])
        pictures = sorted(log.glob(f"{place}/*.*g"))
        early, late = (str(one.relative_to(log)) for one in (pictures[0], pictures[-1]))
        window = Selection(end_ns=first + 300_000_000)
        return log, window, {early: True, late: False}
    if kind == "blf":
        log = folder / "can.blf"
        frames = random_frames(60_000, step_ns=1_000_000)
        log.write_bytes(blf(frames, stored=True, container=60_000))
    else:
        log = folder / "x.mf4"
        at_s = np.arange(400_000) * 1e-3
        with asammdf.MDF(version="4.10") as mdf:
            mdf.configure(write_fragment_size=1 << 18)
            mdf.append([asammdf.Signal(at_s * 3.0, at_s, name="speed")], acq_name="drive")
            mdf.save(log, compression=0)
    assert log.stat().st_size > 3 * MIB
    begin = int(read(log)[0][0].log_ns[0])
    return log, Selection(end_ns=begin + 500_000_000), {}


@pytest.mark.parametrize("kind", ["blf", "mf4", "images", "kitti-raw", "pandaset"])
def test_window_checks_only_blocks_that_it_reads(tmp_path: Path, kind: str) -> None:
    log, window, files = _window_case(kind, tmp_path)
    assert run(["seal", str(log)]) == 0
    total = read_seal(seal_path(log)).blocks

    def losses(selection: Selection) -> tuple[int, list[str]]:
        ledger = Ledger(str(log))
        with open_log(log) as opened:
            for _ in opened.read(ledger, selection):
                pass
        found = re.search(r"(\d+) of \d+ blocks", ledger.integrity)
        details = [drop.detail for drop in ledger.drops() if drop.reason == DIFFERS]
        return int(found[1]) if found else total, details

    checked, none = losses(window)
    assert 0 < checked < total
    assert not none
    # A byte of a payload, or one that no decoder reads: only the seal can detect it.
    if not files:
        at = int(log.stat().st_size * 0.6)
        _flip(log, at)
        assert losses(window) == (checked, [])
        begin = at // MIB * MIB
        assert f"{log.name}: bytes {begin} to {begin + MIB}" in losses(Selection())[1]
        return
    for name, is_read in files.items():
        size = (log / name).stat().st_size
        _flip(log / name, size - 1)
        assert losses(window) == (checked, [f"{name}: bytes 0 to {size}"] if is_read else [])
        _flip(log / name, size - 1)


def test_file_of_sealed_folder_is_checked_against_folder_seal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = write_folder(tmp_path / "bag", rows_of(50))
    assert run(["seal", str(place)]) == 0
    database = next(place.glob("*.db3"))
    assert "all 1 blocks of 1 MiB were checked, none differs" in read(database)[1].integrity
    run(["info", "--quick", str(database)])
    assert f"by {place.name}.seal of the folder" in " ".join(capsys.readouterr().out.split())

    _flip(database, database.stat().st_size - 5)
    assert f"{database.name}: bytes 0 to {database.stat().st_size}" in _losses_text(database)
    assert run(["seal", "--check", str(database)]) == 3
    # Read as a part of its folder, it is reported once.
    details = [drop.detail for drop in read(place)[1].drops() if drop.reason == DIFFERS]
    assert details == [f"{database.name}: bytes 0 to {database.stat().st_size}"]


def test_subfolder_of_sealed_folder_is_checked_against_seal(tmp_path: Path) -> None:
    drive = _sealed(tmp_path, "kitti-raw")
    camera = drive / "image_02" / "data"
    one = sorted(camera.iterdir())[3]
    assert "none differs" in read(camera)[1].integrity

    _flip(one, one.stat().st_size - 1)
    assert f"{one.name}: bytes 0 to {one.stat().st_size}" in _losses_text(camera)


def test_log_added_to_sealed_folder_is_not_sealed(tmp_path: Path) -> None:
    place = write_folder(tmp_path / "bag", rows_of(50))
    assert run(["seal", str(place)]) == 0
    late = place / "can.log"
    late.write_bytes(candump(random_frames(30)))

    assert read(late)[1].is_whole
    assert "sealed" not in read(late)[1].integrity
    assert not read(place)[1].is_whole


def test_interrupted_seal_leaves_files_unchanged(
    long_log: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = seal_path(long_log).read_bytes()
    names = sorted(path.name for path in long_log.parent.iterdir())
    hashed = 0

    def interrupted(*given: Any) -> Iterator[bytes]:
        nonlocal hashed
        for digest in digests_of(*given):
            hashed += 1
            if hashed == 2:
                raise KeyboardInterrupt
            yield digest

    monkeypatch.setattr(sealing, "digests_of", interrupted)
    for argv in (["seal", "--overwrite", str(long_log)], ["seal", "--check", str(long_log)]):
        hashed = 0
        assert run(argv) == 130
        assert "Traceback" not in capsys.readouterr().err
    assert seal_path(long_log).read_bytes() == before
    assert sorted(path.name for path in long_log.parent.iterdir()) == names


def test_sealing_reports_its_progress_in_bytes(long_log: Path) -> None:
    work = sealing.Sealing(long_log)
    done = list(work)

    assert work.total == long_log.stat().st_size == done[-1]
    assert done == sorted(done)
    assert len(done) == read_seal(seal_path(long_log)).blocks
