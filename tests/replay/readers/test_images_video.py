"""Pictures and videos as logs, and their files of times."""

import os
from decimal import Decimal
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from crosscue.replay.base import Selection
from crosscue.replay.columns import Block, Images
from crosscue.replay.errors import LogError, LogFormatError
from crosscue.replay.ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC
from crosscue.replay.limits import DEFAULT_LIMITS, Limits
from crosscue.replay.readers.time_file import TimeFile, read_time_file
from support.accounted import read
from support.pictures import picture, picture_folder
from support.trees import written
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
    cut = written(tmp_path / f"cut{whole.suffix}", raw[: int(fraction * len(raw))])
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
    damaged = written(tmp_path / "damaged.mp4", raw)

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
    folder = picture_folder(tmp_path / "front", 6, "0.5\n1.5\n2.5\n3.5\n4.5\n")
    (folder / "frame_2.png").unlink()

    blocks, ledger = read(folder)

    assert len(pictures_read(blocks)) == 5
    assert "1 numbers are missing" in ledger.notices[0]


quick = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
moments = st.lists(st.integers(0, (1 << 62) - 1), min_size=1, max_size=20, unique=True)

EUROC = [1403636579763555584, 1403636579813555456]


def read_file(folder: Path, text: str) -> TimeFile:
    path = folder / "timestamps.txt"
    path.write_text(text, encoding="utf-8")
    return read_time_file(path, DEFAULT_LIMITS)


@quick
@given(moments)
def test_seconds_are_parsed_to_the_nanosecond(tmp_path: Path, t_ns: list[int]) -> None:
    lines = "\n".join(f"{Decimal(t) / S:.9f}" for t in t_ns)

    assert read_file(tmp_path, lines).t_ns.tolist() == t_ns


@pytest.mark.parametrize(
    ("text", "t_ns", "names"),
    [
        ("0.5\n1.25\n", [S // 2, 5 * S // 4], None),
        ("1.5e-1\n2.5E1", [150_000_000, 25 * S], None),
        ("1403636579763555584\n1403636579813555456", EUROC, None),
        ("# a comment\n\n7.0\r\n8.0\r\n", [7 * S, 8 * S], None),
        ("\ufeff7.0\n8.0", [7 * S, 8 * S], None),
        ("2011-09-26 13:02:25.964389445", [1317042145964389445], None),
        ("2011-09-26T15:02:25.964389445+02:00", [1317042145964389445], None),
        ("2011-09-26 13:02:25,5", [1317042145500000000], None),
        ("a.jpg,0.5\nb.jpg,1.5", [S // 2, 3 * S // 2], ("a.jpg", "b.jpg")),
        ("0.5 rgb/a.png\n1.5 rgb/b.png", [S // 2, 3 * S // 2], ("a.png", "b.png")),
        ("a.jpg;2011-09-26 13:02:25.5", [1317042145500000000], ("a.jpg",)),
        ("2011-09-26 13:02:25.5 a.jpg", [1317042145500000000], ("a.jpg",)),
        ("name,time\na.jpg,0.5", [S // 2], ("a.jpg",)),
        ("#timestamp [ns],filename\n1403636579763555584,a.png", [1403636579763555584], ("a.png",)),
        ("frame,time_ms\n0,0\n1,40\n2,80", [0, 40_000_000, 80_000_000], None),
        ("frame,time [s],speed\n0,3,1.5\n1,4,1.6", [3 * S, 4 * S], None),
        ("timestamp_us\n1000000\n1040000", [S, 1_040_000_000], None),
        ('"name","time"\n"a b.jpg","0.5"', [S // 2], ("a b.jpg",)),
    ],
)
def test_supported_notations_are_parsed(
    tmp_path: Path, text: str, t_ns: list[int], names: tuple[str, ...] | None
) -> None:
    times = read_file(tmp_path, text)

    assert times.t_ns.tolist() == t_ns
    assert times.names == names


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0.1\n0.2\nlater\n", r"timestamps.txt: line 3: 'later': expected one time"),
        ("0.1\n\n# x\n0.2 0.3", "line 4: .*expected one time"),
        ("pictures of a cat", "line 1: 'pictures of a cat': expected a time"),
        ("0.1\nnan", "line 2"),
        ("-1.0", "line 1: '-1.0': expected a time from 0 on"),
        ("9999999999.5", "line 1: '9999999999.5': expected a time from 0 on and before 2116"),
        ("1e99", "line 1"),
        ("2011-02-30 13:02:25.5", "line 1: .* is not a time: day is out of range"),
        ("name,time\na.jpg", "line 2: 1 cells; expected 2"),
        ("name,time\na.jpg,soon", "line 2: 'soon' is not a time"),
        ("a.jpg,0.1\n0.2", "line 2: .*expected a file name in every line"),
        ("a.jpg,0.1\na.jpg,0.2", "'a.jpg' occurs twice"),
        ("", "no time in it"),
        ("# only words\n", "no time in it"),
        ("rate_hz: fast", "rate_hz 'fast'; expected a rate"),
        ("rate_hz: 0", "rate_hz '0'; expected a rate"),
        ("0\n1\n2\n", "integers 1 apart are read as nanoseconds"),
        ("1500000000000\n1500000000040", "integers 40 apart are read as nanoseconds"),
        ("a,b,c\n1,2,3", "line 1: 'a,b,c': expected a time"),
    ],
)
def test_invalid_line_is_refused_with_its_number(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(LogFormatError, match=message):
        read_file(tmp_path, text)


@quick
@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused_in_one_line(tmp_path: Path, raw: bytes) -> None:
    path = written(tmp_path / "times.txt", raw)
    refusal, count = "", 1
    try:
        times = read_time_file(path, DEFAULT_LIMITS)
        count = 1 if times.period else len(times.t_ns)
    except LogFormatError as error:
        refusal = str(error)

    assert count > 0
    assert "\n" not in refusal
