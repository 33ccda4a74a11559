"""Identity of logs and seals: a changed byte is detected and located in every format."""

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crosscue.eval.cli import run
from crosscue.replay.base import Selection
from crosscue.replay.errors import LogError
from crosscue.replay.files.identity import SHARE_BYTES, log_identity
from crosscue.replay.ledger import CHANGED, DIFFERS, Ledger
from crosscue.replay.limits import MIB
from crosscue.replay.logs.opening import open_log
from crosscue.replay.seal import seal as sealing
from crosscue.replay.seal.log import Touching
from crosscue.replay.seal.seal import digests_of, read_seal, seal_path
from crosscue.replay.versions import commit
from support.accounted import read
from support.can_files import candump, random_frames
from support.every_format import EVERY_FORMAT
from support.pictures import picture_folder
from support.refusals import refusal
from support.rosbag_files import rows_of, write_bag, write_folder
from support.trees import written

LARGE: int = 3 * SHARE_BYTES
# Position between the last sample and the tail, where only an index is hashed.
BEFORE_TAIL: int = LARGE - SHARE_BYTES // 4 - SHARE_BYTES // 64 - 3


EDGE = SHARE_BYTES // 4
SMALL_AT = (0, 1, SHARE_BYTES // 3, SHARE_BYTES // 2 + 7, SHARE_BYTES - 1)
LARGE_AT = (0, EDGE - 1, LARGE - 1, LARGE - EDGE, EDGE + 1)


@pytest.mark.parametrize(
    ("size", "at"), [*((SHARE_BYTES, at) for at in SMALL_AT), *((LARGE, at) for at in LARGE_AT)]
)
def test_bytes_of_small_log_and_edges_and_samples_of_large_one_change_identity(
    tmp_path: Path, size: int, at: int
) -> None:
    content = bytearray(size)
    before = log_identity(written(tmp_path / "a.mcap", content))
    content[at] ^= 1

    assert log_identity(written(tmp_path / "a.mcap", content)).digest != before.digest
    assert log_identity(written(tmp_path / "a.mcap", content + b"x")).digest != before.digest


def _with_index(kind: str, start: int) -> bytearray:
    """Return a large file of zeros, whose header or footer places the index at ``start``."""
    content = bytearray(LARGE)
    if kind == "mcap":
        content[:8] = b"\x89MCAP0\r\n"
        footer = bytes([2]) + (20).to_bytes(8, "little") + start.to_bytes(8, "little")
        content[-37:] = footer + bytes(12) + b"\x89MCAP0\r\n"
    else:
        head = b"#ROSBAG V2.0\n" + (0).to_bytes(4, "little") + b"index_pos="
        content[: len(head) + 8] = head + start.to_bytes(8, "little")
    return content


@pytest.mark.parametrize("kind", ["mcap", "bag"])
def test_any_index_byte_of_large_log_changes_identity(tmp_path: Path, kind: str) -> None:
    for start, counts in ((BEFORE_TAIL - 10, True), (BEFORE_TAIL + 1, False)):
        content = _with_index(kind, start)
        before = log_identity(written(tmp_path / f"a.{kind}", content))
        content[BEFORE_TAIL] ^= 1
        assert (log_identity(written(tmp_path / f"a.{kind}", content)) != before) is counts


def test_folder_identity_covers_all_files_except_our_own(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "images"
    for i in range(5):
        written(folder / f"{i}.png", bytes([i]))
    written(folder / "deep" / "x.png", "rows")
    before = log_identity(folder)

    for name in ("truth.json", "vehicle.toml", ".DS_Store", "x.seal"):
        written(folder / name, "rows")
    assert log_identity(folder) == before
    assert log_identity(shutil.copytree(folder, tmp_path / "b" / "images")) == before

    changed = []
    for change in (
        lambda: written(folder / "deep" / "x.png", b"other"),
        lambda: (folder / "4.png").rename(folder / "5.png"),
        lambda: (folder / "3.png").unlink(),
        lambda: written(folder.with_name("images.csv"), b"0.1"),
    ):
        change()
        changed.append(log_identity(folder).digest)
    assert len({before.digest, *changed}) == 5


def _git(folder: Path, *words: str) -> str:
    """Run git without user settings, and return its output."""
    identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "init.defaultBranch=main"]
    command = ["git", *identity, *words]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create a repository with one commit."""
    folder = tmp_path_factory.mktemp("checkout")
    _git(folder, "init")
    _git(folder, "commit", "--allow-empty", "-m", "first")
    return folder


def test_commit_equals_git_head(checkout: Path) -> None:
    head = _git(checkout, "rev-parse", "HEAD").strip()

    assert commit(checkout) == head
    _git(checkout, "pack-refs", "--all")
    commit.cache_clear()
    assert commit(checkout) == head
    _git(checkout, "worktree", "add", "-b", "other", "../worktree")
    assert commit(checkout.parent / "worktree") == head
    _git(checkout, "checkout", "--detach")
    commit.cache_clear()
    assert commit(checkout) == head


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
    log = written(tmp_path / "can.log", candump(random_frames(300)) * 300)
    assert log.stat().st_size > 3 * MIB
    assert run(["seal", str(log)]) == 0
    return log


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
    assert run(["check", f"{log}.seal"]) == 0


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
    assert run(["check", f"{log}.seal"]) == 3
    assert f"{name}: bytes 0 to {size} differ from the seal" in capsys.readouterr().out


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


def test_seal_of_changed_log_is_replaced_only_with_overwrite(
    long_log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = seal_path(long_log).read_bytes()
    assert run(["seal", str(long_log)]) == 0
    assert seal_path(long_log).read_bytes() == before

    _flip(long_log, 7)
    capsys.readouterr()
    assert "--overwrite only if the log is correct" in refusal(1, "seal", long_log)
    assert seal_path(long_log).read_bytes() == before

    assert run(["seal", "--overwrite", str(long_log)]) == 0
    assert run(["check", f"{long_log}.seal"]) == 0


@pytest.mark.parametrize("suffix", ["-wal", "-journal"])
def test_journal_of_sqlite_log_is_sealed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], suffix: str
) -> None:
    log = EVERY_FORMAT["rosbag2-sqlite3"](tmp_path)
    journal = written(log.with_name(log.name + suffix), bytes(100))
    assert run(["seal", str(log)]) == 0
    assert set(read_seal(seal_path(log)).files) == {".", journal.name}
    _flip(journal, 30)
    assert run(["check", f"{log}.seal"]) == 3
    assert f"{journal.name}: bytes 0 to 100 differ from the seal" in capsys.readouterr().out


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
def test_damaged_seal_is_refused_in_one_line(tmp_path: Path, why: str, content: bytes) -> None:
    log = EVERY_FORMAT["candump"](tmp_path)
    seal_path(log).write_bytes(content)

    for argv in (["info", str(log)], ["check", f"{log}.seal"]):
        reported = refusal(4, *argv)
        assert why in reported
        assert "delete it and seal the log again" in reported
    assert run(["seal", str(log)]) == 1


@pytest.mark.parametrize(
    ("log", "status", "why"),
    [
        ("s3://bucket/a.bag", 2, "a URL cannot be sealed"),
        ("can.log.seal", 2, "is a seal itself"),
        ("gone.bag", 4, "no such file"),
    ],
)
def test_seal_of_invalid_log_is_refused(tmp_path: Path, log: str, status: int, why: str) -> None:
    EVERY_FORMAT["asc"](tmp_path)

    assert why in refusal(status, "seal", log if "://" in log else tmp_path / log)


def test_check_of_log_without_seal_fails(tmp_path: Path) -> None:
    assert "not sealed" in refusal(1, "check", f"{EVERY_FORMAT['asc'](tmp_path)}.seal")


def test_convert_does_not_overwrite_a_sealed_log(tmp_path: Path) -> None:
    log = EVERY_FORMAT["candump"](tmp_path)
    out = tmp_path / "out.mcap"
    assert run(["convert", str(log), "-o", str(out)]) == 0
    assert run(["seal", str(out)]) == 0
    before = out.read_bytes()

    assert "out.mcap.seal" in refusal(1, "convert", log, "-o", out, "--overwrite")
    assert out.read_bytes() == before


def test_file_of_sealed_folder_is_checked_against_folder_seal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = write_folder(tmp_path / "bag", rows_of(50))
    assert run(["seal", str(place)]) == 0
    database = next(place.glob("*.db3"))
    assert "1 of 1 block of 1 MiB were checked, none differs" in read(database)[1].integrity
    run(["info", "--quick", str(database)])
    assert f"by {place.name}.seal of the folder" in " ".join(capsys.readouterr().out.split())

    _flip(database, database.stat().st_size - 5)
    assert f"{database.name}: bytes 0 to {database.stat().st_size}" in _losses_text(database)
    assert run(["check", f"{database}.seal"]) == 3
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
    for argv in (["seal", "--overwrite", str(long_log)], ["check", f"{long_log}.seal"]):
        hashed = 0
        assert run(argv) == 130
        assert "Traceback" not in capsys.readouterr().err
    assert seal_path(long_log).read_bytes() == before
    assert sorted(path.name for path in long_log.parent.iterdir()) == names


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


def test_log_added_to_sealed_folder_is_not_sealed(tmp_path: Path) -> None:
    place = write_folder(tmp_path / "bag", rows_of(50))
    assert run(["seal", str(place)]) == 0
    late = written(place / "can.log", candump(random_frames(30)))

    assert read(late)[1].is_whole
    assert "sealed" not in read(late)[1].integrity
    assert not read(place)[1].is_whole


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
        ledger = read(log, selection)[1]
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


def test_blocks_read_are_recorded_for_a_seal_only(tmp_path: Path) -> None:
    log = next(write_folder(tmp_path / "bag", rows_of(40_000), "mcap").glob("*.mcap"))
    assert log.stat().st_size > 3 * MIB
    with open_log(log) as opened:
        assert isinstance(opened, Touching)
        blocks = sum(1 for _ in opened.read(Ledger(str(log))))
        recorded = opened.touched.of_opening()[log]
    assert blocks > 1
    assert 1 not in recorded
