"""Folders of images: every image is used, skipped or dropped, and paired with the right time."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.columns import Block, Images
from crosscue.replay.limits import Limits
from support.accounted import read
from support.pictures import picture, picture_folder

FIVE = "0.5\n1.5\n2.5\n3.5\n4.5\n"


S = 1_000_000_000


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


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
@settings(max_examples=25)
@given(fraction=st.floats(0.0, 0.999))
def test_truncated_picture_is_reported(tmp_path: Path, suffix: str, fraction: float) -> None:
    folder = picture_folder(tmp_path / "front", 2, "0.5\n1.5", suffix)
    whole = picture(0, suffix)
    (folder / f"frame_0{suffix}").write_bytes(whole[: int(fraction * len(whole))])

    blocks, ledger = read(folder)

    assert pictures_read(blocks) == [(1.5, picture(1, suffix))]
    account = ledger.topic("front")
    assert account.skipped.total() + account.dropped.total() == 1


def test_named_pipe_instead_of_picture_is_dropped(tmp_path: Path) -> None:
    folder = picture_folder(tmp_path / "front", 2, "0.5\n1.5")
    (folder / "frame_0.png").unlink()
    os.mkfifo(folder / "frame_0.png")

    blocks, ledger = read(folder)

    assert len(pictures_read(blocks)) == 1
    assert ledger.topic("front").dropped == {"picture cannot be opened": 1}


def test_picture_over_size_limit_is_skipped(tmp_path: Path) -> None:
    folder = picture_folder(tmp_path / "front", 3, "0.5\n1.5\n2.5")
    (folder / "frame_1.png").write_bytes(picture(1) + bytes(5000))

    blocks, ledger = read(folder, limits=Limits(message_bytes=4000))

    assert len(pictures_read(blocks)) == 2
    assert ledger.topic("front").skipped == {"picture over the size limit": 1}


def test_coding_is_detected_from_content_not_suffix(tmp_path: Path) -> None:
    folder = picture_folder(tmp_path / "front", 2, "0.5\n1.5")
    (folder / "frame_1.png").write_bytes(picture(1, ".jpg"))

    (block,), _ = read(folder)

    assert isinstance(block.rows, Images)
    assert block.rows.coding == ("png", "jpeg")


def test_numbering_gap_with_matching_number_of_times_is_reported(tmp_path: Path) -> None:
    folder = picture_folder(tmp_path / "front", 6, FIVE)
    (folder / "frame_2.png").unlink()

    blocks, ledger = read(folder)

    assert len(pictures_read(blocks)) == 5
    assert "1 numbers are missing" in ledger.notices[0]
