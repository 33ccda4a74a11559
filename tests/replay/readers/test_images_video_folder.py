"""Folders of images: every image is used, skipped or dropped, and paired with the right time."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from crosscue.replay.base import Selection
from crosscue.replay.columns import BLOCK_BYTES, Block, Images
from crosscue.replay.errors import LogError, LogFormatError, UnknownFormatError
from crosscue.replay.ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC
from crosscue.replay.limits import Limits
from crosscue.replay.logs.opening import open_log
from support.accounted import read
from support.data import shared
from support.pictures import picture, picture_folder

S = 1_000_000_000
FIVE = "0.5\n1.5\n2.5\n3.5\n4.5\n"


def pictures_read(blocks: list[Block]) -> list[tuple[float, bytes]]:
    """Return the time in seconds and the bytes of every image."""
    rows = []
    for block in blocks:
        assert isinstance(block.rows, Images)
        for i, t_ns in enumerate(block.log_ns.tolist()):
            rows.append((t_ns / S, bytes(block.rows.bytes_.payload(i))))
    return rows


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_pictures_are_read_in_natural_order_with_their_times(tmp_path: Path, suffix: str) -> None:
    folder = picture_folder(tmp_path / "front", 12, "\n".join(f"{i}.5" for i in range(12)), suffix)

    blocks, ledger = read(folder)

    assert pictures_read(blocks) == [(i + 0.5, picture(i, suffix)) for i in range(12)]
    assert ledger.is_whole
    assert ledger.notices == []
    assert ledger.topic("front").declared == 12
    assert ledger.integrity.startswith({".png": "PNG", ".jpg": "JPEG", ".webp": "WebP"}[suffix])


def test_coding_is_detected_from_content_not_suffix(tmp_path: Path) -> None:
    folder = picture_folder(tmp_path / "front", 2, "0.5\n1.5")
    (folder / "frame_1.png").write_bytes(picture(1, ".jpg"))

    (block,), _ = read(folder)

    assert isinstance(block.rows, Images)
    assert block.rows.coding == ("png", "jpeg")


def test_names_in_time_file_pair_pictures_and_unpaired_ones_are_dropped(tmp_path: Path) -> None:
    folder = picture_folder(
        tmp_path / "front", 3, "frame_2.png,0.5\nframe_0.png,1.5\ngone.png,2.5\n"
    )

    blocks, ledger = read(folder)

    assert pictures_read(blocks) == [(1.5, picture(0)), (0.5, picture(2))]
    account = ledger.topic("front")
    assert account.dropped["a picture without its time"] == 1
    assert account.dropped["a time without its picture"] == 1
    assert "frame_1.png" in ledger.details[0].detail


def test_missing_picture_number_leaves_gap_in_times(tmp_path: Path) -> None:
    folder = picture_folder(tmp_path / "front", 5, FIVE)
    (folder / "frame_2.png").unlink()

    blocks, ledger = read(folder)

    assert [t for t, _ in pictures_read(blocks)] == [0.5, 1.5, 3.5, 4.5]
    assert ledger.topic("front").dropped == {"a time without its picture": 1}
    assert ledger.details[0].t_ns == 5 * S // 2
    assert ledger.notices == [
        "front: 1 numbers are missing in the file names; times are paired by number"
    ]


def test_mismatched_counts_of_times_and_pictures_are_reported(tmp_path: Path) -> None:
    fewer = picture_folder(tmp_path / "fewer", 3, FIVE)
    more = picture_folder(tmp_path / "more", 7, FIVE)

    _, of_fewer = read(fewer)
    _, of_more = read(more)

    assert of_fewer.topic("fewer").dropped == {"a time without its picture": 2}
    assert "paired in order from the first" in of_fewer.notices[0]
    assert of_more.topic("more").dropped == {"a picture without its time": 2}
    assert any("7 files and 5 times" in notice for notice in of_more.notices)


def test_numbering_gap_with_matching_number_of_times_is_reported(tmp_path: Path) -> None:
    folder = picture_folder(tmp_path / "front", 6, FIVE)
    (folder / "frame_2.png").unlink()

    blocks, ledger = read(folder)

    assert len(pictures_read(blocks)) == 5
    assert "1 numbers are missing" in ledger.notices[0]


def test_constant_rate_is_reported_and_keeps_gaps(tmp_path: Path) -> None:
    folder = picture_folder(tmp_path / "front", 5, "rate_hz: 2\n")
    (folder / "frame_3.png").unlink()

    blocks, ledger = read(folder)

    assert [t for t, _ in pictures_read(blocks)] == [0.0, 0.5, 1.0, 2.0]
    assert "computed from a constant rate of 2 Hz" in ledger.notices[0]
    assert ledger.topic("front").declared is None


def test_damaged_truncated_and_unsupported_files_are_not_read(tmp_path: Path) -> None:
    folder = picture_folder(tmp_path / "front", 5, FIVE)
    whole = picture(0)
    (folder / "frame_0.png").write_bytes(b"")
    (folder / "frame_1.png").write_bytes(b"<html>not a picture</html>")
    (folder / "frame_2.png").write_bytes(whole[:-20])
    (folder / "frame_3.png").write_bytes(whole[:40] + b"\x7f" + whole[41:])

    blocks, ledger = read(folder)

    assert pictures_read(blocks) == [(4.5, picture(4))]
    account = ledger.topic("front")
    assert account.skipped == {"empty file": 1, "not a JPEG, PNG or WebP picture": 1}
    assert account.dropped == {"picture cut short": 1, "picture damaged (checksum)": 1}


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(fraction=st.floats(0.0, 0.999))
def test_truncated_picture_is_reported(tmp_path: Path, suffix: str, fraction: float) -> None:
    folder = picture_folder(tmp_path / "front", 2, "0.5\n1.5", suffix)
    whole = picture(0, suffix)
    (folder / f"frame_0{suffix}").write_bytes(whole[: int(fraction * len(whole))])

    blocks, ledger = read(folder)

    assert pictures_read(blocks) == [(1.5, picture(1, suffix))]
    account = ledger.topic("front")
    assert account.skipped.total() + account.dropped.total() == 1


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(at=st.integers(0, 10_000), flip=st.integers(1, 255))
def test_png_with_flipped_byte_is_not_read(tmp_path: Path, at: int, flip: int) -> None:
    folder = picture_folder(tmp_path / "front", 2, "0.5\n1.5")
    changed = bytearray(picture(0))
    changed[at % len(changed)] ^= flip
    (folder / "frame_0.png").write_bytes(changed)

    blocks, _ = read(folder)

    assert pictures_read(blocks) == [(1.5, picture(1))]


def test_picture_over_size_limit_is_skipped(tmp_path: Path) -> None:
    folder = picture_folder(tmp_path / "front", 3, "0.5\n1.5\n2.5")
    (folder / "frame_1.png").write_bytes(picture(1) + bytes(5000))

    blocks, ledger = read(folder, limits=Limits(message_bytes=4000))

    assert len(pictures_read(blocks)) == 2
    assert ledger.topic("front").skipped == {"picture over the size limit": 1}


def test_blocks_stay_within_size_limit(tmp_path: Path) -> None:
    folder = tmp_path / "front"
    folder.mkdir()
    noise = np.random.default_rng(1).bytes(3 << 20)
    for i in range(6):
        (folder / f"{i}.jpg").write_bytes(b"\xff\xd8" + noise + b"\xff\xd9")
    (folder / "times.txt").write_text("rate_hz: 10")

    blocks, _ = read(folder)

    assert [len(b) for b in blocks] == [2, 2, 2]
    for block in blocks:
        assert isinstance(block.rows, Images)
        assert len(block.rows.bytes_.buffer) <= BLOCK_BYTES


def test_unselected_pictures_are_counted_but_not_read(tmp_path: Path) -> None:
    folder = picture_folder(tmp_path / "front", 5, FIVE)
    for outside in (0, 4):
        (folder / f"frame_{outside}.png").write_bytes(b"never read")

    blocks, ledger = read(folder, Selection(start_ns=1 * S, end_ns=4 * S))
    none, not_asked = read(folder, Selection(topics=frozenset({"other"})))

    assert [t for t, _ in pictures_read(blocks)] == [1.5, 2.5, 3.5]
    assert ledger.topic("front").skipped == {NOT_ASKED_TIME: 2}
    assert none == []
    assert not_asked.topic("front").skipped == {NOT_ASKED_TOPIC: 5}
    assert ledger.is_whole
    assert not_asked.is_whole


def test_folder_without_time_file_is_refused_with_instructions(tmp_path: Path) -> None:
    folder = picture_folder(tmp_path / "front", 2)

    with pytest.raises(LogFormatError, match=r"2 pictures but no time file; write timestamps.txt"):
        open_log(folder)


def test_folder_without_pictures_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "a.txt").write_text("dear")

    for name in ("empty", "letters"):
        with pytest.raises(UnknownFormatError, match="without a known log"):
            open_log(tmp_path / name)


def test_time_file_naming_no_picture_of_folder_is_refused(tmp_path: Path) -> None:
    folder = picture_folder(tmp_path / "front", 2, "left_0.png,0.5\n")

    with pytest.raises(LogFormatError, match=r"no line names a file .* 'frame_0.png'"):
        open_log(folder)


@pytest.fixture
def public_folder() -> Iterator[Path]:
    """Yield a folder that all users can read; restore this process's user afterwards."""
    open_to_all = Path(tempfile.mkdtemp(dir=tempfile.gettempdir()))
    open_to_all.chmod(0o755)
    was = os.geteuid()
    yield open_to_all
    os.seteuid(was)
    for path in open_to_all.rglob("*"):
        path.chmod(0o755)
    shutil.rmtree(open_to_all)


def test_unreadable_folder_is_refused(public_folder: Path) -> None:
    folder = picture_folder(public_folder / "front", 2, "0.5\n1.5")
    folder.chmod(0)
    if os.geteuid() == 0:
        os.seteuid(65534)

    with pytest.raises(LogError, match=r"front: Permission denied; check the path"):
        open_log(folder)


def test_unreadable_picture_is_dropped_and_others_are_read(public_folder: Path) -> None:
    folder = picture_folder(public_folder / "front", 2, "0.5\n1.5")
    (folder / "frame_0.png").chmod(0)
    if os.geteuid() == 0:
        os.seteuid(65534)

    blocks, ledger = read(folder)

    assert len(pictures_read(blocks)) == 1
    assert "Permission denied" in next(ledger.drops()).detail


def test_uppercase_suffixes_are_recognised(tmp_path: Path) -> None:
    folder = picture_folder(tmp_path / "front", 1, "0.5\n1.5")
    (folder / "frame_0.png").rename(folder / "FRAME_0.PNG")
    (folder / "FRAME_1.JPG").write_bytes(picture(1, ".jpg"))

    blocks, _ = read(folder)

    assert pictures_read(blocks) == [(0.5, picture(0)), (1.5, picture(1, ".jpg"))]


def test_unreadable_time_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = picture_folder(tmp_path / "front", 2, "0.5\n1.5")

    def refuse(self: Path, mode: str) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(LogError, match="no permission to read it"):
        open_log(folder)


def test_named_pipe_instead_of_picture_is_dropped(tmp_path: Path) -> None:
    folder = picture_folder(tmp_path / "front", 2, "0.5\n1.5")
    (folder / "frame_0.png").unlink()
    os.mkfifo(folder / "frame_0.png")

    blocks, ledger = read(folder)

    assert len(pictures_read(blocks)) == 1
    assert ledger.topic("front").dropped == {"picture cannot be opened": 1}


def test_real_dashcam_frames_are_all_read_at_constant_rate(tmp_path: Path) -> None:
    source = shared("sequences", "us_signalized_intersection_dashcam")
    folder = tmp_path / "dashcam"
    folder.mkdir()
    for path in source.glob("*.jpg"):
        shutil.copy(path, folder / path.name)
    (folder / "times.txt").write_text("rate_hz: 15\n")

    blocks, ledger = read(folder)

    t_ns = np.concatenate([b.log_ns for b in blocks])
    assert len(t_ns) == 111
    np.testing.assert_allclose(np.diff(t_ns), S / 15, atol=1.0)
    assert ledger.is_whole
