"""Videos: images have the times at which they were filmed, and truncation is reported."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.base import Selection
from crosscue.replay.columns import Block, Images
from crosscue.replay.errors import LogError
from crosscue.replay.ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC
from support.accounted import read
from support.videos import number_of, numbers_at_times, video

N = 24
NO_REORDERING = {"bf": "0"}
REORDERING = {"bf": "3", "b-adapt": "0", "g": "12"}
TIMES_S = [100.0 + 0.05 * i + (0.3 if i > 9 else 0.0) for i in range(N)]
TIMES_NS = [round(t * 1000) * 1_000_000 for t in TIMES_S]
TIME_LINES = "\n".join(f"{t:.3f}" for t in TIMES_S)


CASES = [
    ("a.mp4", "libx264", NO_REORDERING, "h264", "h264"),
    ("a.mp4", "libx264", REORDERING, "h264", "h264"),
    ("a.mov", "libx264", REORDERING, "h264", "h264"),
    ("a.mkv", "libx264", REORDERING, "h264", "h264"),
    ("a.avi", "libx264", NO_REORDERING, "h264", "h264"),
    ("a.h264", "libx264", NO_REORDERING, "h264", "h264"),
    ("a.mp4", "libx265", {"x265-params": "log-level=none"}, "h265", "hevc"),
    ("a.hevc", "libx265", {"x265-params": "log-level=none:bframes=0"}, "h265", "hevc"),
    ("a.avi", "mjpeg", {}, "jpeg", "mjpeg"),
    ("a.mkv", "mjpeg", {}, "jpeg", "mjpeg"),
]


@pytest.mark.parametrize(("name", "codec", "options", "coding", "decoder"), CASES)
def test_each_picture_has_its_recording_time(
    tmp_path: Path, name: str, codec: str, options: dict[str, str], coding: str, decoder: str
) -> None:
    path = video(tmp_path / name, N, codec, options)
    path.with_suffix(".txt").write_text(TIME_LINES)

    blocks, ledger = read(path)

    assert numbers_at_times(blocks, decoder) == {t: i for i, t in enumerate(TIMES_NS)}
    assert ledger.is_whole
    assert ledger.topic("a").declared == N
    for block in blocks:
        assert isinstance(block.rows, Images)
        assert set(block.rows.coding) == {coding}
        if coding in ("h264", "h265"):
            assert bytes(block.rows.bytes_.payload(0))[:3] in (b"\0\0\0", b"\0\0\1")


def _number_in(block: Block) -> int:
    """Return the number that is drawn in a decoded image."""
    rows = block.rows
    assert isinstance(rows, Images)
    assert (rows.coding, rows.pixel_format) == (("raw",), ("rgb8",))
    assert rows.width_px is not None
    assert rows.width_px.tolist() == [64]
    return number_of(np.frombuffer(rows.bytes_.payload(0), dtype=np.uint8))


def _zero_packet(path: Path, which: int) -> None:
    """Overwrite the bytes of one stored image with zeros."""
    with av.open(str(path)) as container:
        packet = [bytes(p) for p in container.demux(video=0) if p.size][which]
    data = path.read_bytes()
    assert data.count(packet) == 1
    path.write_bytes(data.replace(packet, bytes(len(packet))))


@pytest.mark.parametrize("name", ["a.mp4", "a.avi"])
@pytest.mark.parametrize("which", [0, 7, N - 1])
def test_undecodable_picture_is_dropped_without_shifting_times(
    tmp_path: Path, name: str, which: int
) -> None:
    path = video(tmp_path / name, N, "mpeg4", {"g": "1"})
    path.with_suffix(".txt").write_text(TIME_LINES)
    _zero_packet(path, which)

    blocks, ledger = read(path)

    shown = [int(b.log_ns[0]) for b in blocks]
    assert shown == TIMES_NS[:which] + TIMES_NS[which + 1 :]
    assert [_number_in(b) for b in blocks] == [i for i in range(N) if i != which]
    assert dict(ledger.topic("a").dropped) == {"picture cannot be decoded": 1}
    (loss,) = (d for d in ledger.details if d.is_dropped)
    assert (loss.t_ns, loss.detail) == (TIMES_NS[which], f"packet {which}")


def test_selection_limits_pictures_and_counts_the_rest(tmp_path: Path) -> None:
    path = video(tmp_path / "a.mp4", N, "libx264", NO_REORDERING)
    path.with_suffix(".txt").write_text(TIME_LINES)

    blocks, ledger = read(path, Selection(start_ns=TIMES_NS[4], end_ns=TIMES_NS[8]))
    none, not_asked = read(path, Selection(topics=frozenset({"b"})))

    assert [t for b in blocks for t in b.log_ns.tolist()] == TIMES_NS[4:8]
    assert ledger.topic("a").skipped == {NOT_ASKED_TIME: N - 4}
    assert none == []
    assert not_asked.topic("a").skipped == {NOT_ASKED_TOPIC: N}


@settings(max_examples=25)
@given(fraction=st.floats(0.0, 0.98))
@pytest.mark.parametrize(
    ("name", "codec", "container", "tail"),
    [
        ("a.mp4", "libx264", {}, "moov at the end"),
        ("f.mp4", "libx264", {"movflags": "faststart"}, "moov in front"),
        ("a.avi", "mjpeg", {}, "avi"),
        ("a.mkv", "libx264", {}, "matroska"),
    ],
)
def test_truncated_video_is_refused_or_reported(
    tmp_path: Path, name: str, codec: str, container: dict[str, str], tail: str, fraction: float
) -> None:
    whole = tmp_path / name
    if not whole.exists():
        video(whole, N, codec, NO_REORDERING if codec == "libx264" else {}, container)
    raw = whole.read_bytes()
    cut = tmp_path / f"cut{whole.suffix}"
    cut.write_bytes(raw[: int(fraction * len(raw))])
    try:
        blocks, ledger = read(cut)
    except LogError as error:
        assert "cut or damaged" in str(error) or "no video stream" in str(error)  # noqa: PT017
        return

    given = sum(len(b) for b in blocks)
    assert not ledger.is_whole or given == N, tail
    shown = numbers_at_times(blocks, {"libx264": "h264"}.get(codec, codec))
    assert all(number == t_ns // 50_000_000 for t_ns, number in shown.items())


@given(at=st.integers(0, 10**6), junk=st.binary(min_size=1, max_size=16))
@settings(max_examples=60)
def test_damaged_video_is_read_or_refused_in_one_line(tmp_path: Path, at: int, junk: bytes) -> None:
    whole = tmp_path / "a.mp4"
    if not whole.exists():
        video(whole, N, "libx264", NO_REORDERING)
    raw = bytearray(whole.read_bytes())
    start = at % len(raw)
    raw[start : start + len(junk)] = junk
    damaged = tmp_path / "damaged.mp4"
    damaged.write_bytes(raw)

    try:
        blocks, _ = read(damaged)
    except LogError as error:
        blocks = []
        assert "\n" not in str(error)  # noqa: PT017
    assert sum(len(b) for b in blocks) <= 2 * N


def test_constant_rate_is_reported(tmp_path: Path) -> None:
    path = video(tmp_path / "a.mp4", N, "libx264", NO_REORDERING)
    path.with_suffix(".txt").write_text("rate_hz: 10")

    blocks, ledger = read(path)

    assert [t for b in blocks for t in b.log_ns.tolist()] == [100_000_000 * i for i in range(N)]
    assert "times are computed from a constant rate of 10 Hz, from 0 on" in ledger.notices
