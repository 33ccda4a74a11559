"""Pictures of all encodings, decoded at the smallest sufficient scale, and pictures drawn in."""

import struct
import zlib
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from crosscue.detectors.base import View
from crosscue.detectors.images import MAX_PIXELS, Encoded, decode, reduction
from crosscue.detectors.overlay import Drawer
from crosscue.replay.columns import Bytes
from crosscue.replay.errors import LogError, LogTooLargeError

COLOUR, GREY = View(), View(is_grey=True)


def _encode(pixels: NDArray[np.uint8] | NDArray[np.uint16], suffix: str) -> Encoded:
    ok, encoded = cv2.imencode(suffix, pixels)
    assert ok
    return Encoded({".jpg": "jpeg"}.get(suffix, suffix[1:]), memoryview(encoded.tobytes()))


def _ramp(height: int = 48, width: int = 64) -> Bytes:
    ramp = np.linspace(20, 230, width)[None, :].repeat(height, axis=0)
    return np.dstack([ramp, ramp * 0.5, ramp * 0.25]).astype(np.uint8)


@pytest.mark.parametrize("suffix", [".png", ".webp", ".jpg", ".bmp"])
@pytest.mark.parametrize("view", [COLOUR, GREY])
def test_every_encoding_is_decoded_to_the_requested_channels(suffix: str, view: View) -> None:
    pixels, size = decode(_encode(_ramp(), suffix), view)

    assert size == (64, 48)
    assert pixels.shape == ((48, 64) if view.is_grey else (48, 64, 3))


@pytest.mark.parametrize(("min_px", "by"), [(None, 1), (64, 1), (33, 1), (32, 2), (10, 4), (8, 8)])
def test_jpeg_is_decoded_at_the_smallest_sufficient_scale(min_px: int | None, by: int) -> None:
    view = View(min_width_px=min_px)

    pixels, size = decode(_encode(_ramp(), ".jpg"), view)

    assert reduction(64, view) == by
    assert pixels.shape == (48 // by, 64 // by, 3)
    assert size == (64, 48)


@pytest.mark.parametrize(("bits", "top"), [(16, 65535), (12, 4095), (10, 1023)])
def test_high_bit_depth_is_scaled_to_the_full_8_bit_range(bits: int, top: int) -> None:
    ramp = np.linspace(0, top, 64)[None, :].repeat(48, axis=0).astype(np.uint16)

    pixels, _ = decode(_encode(ramp, ".png"), GREY, depth_bits=bits)

    assert pixels.min() == 0
    assert pixels.max() == 255


@pytest.mark.parametrize(
    ("name", "channels", "depth"),
    [
        ("mono8", 1, 1),
        ("mono16", 1, 2),
        ("bgr8", 3, 1),
        ("rgb8", 3, 1),
        ("rgba8", 4, 1),
        ("bayer_rggb8", 1, 1),
    ],
)
@pytest.mark.parametrize("view", [COLOUR, GREY])
def test_raw_pictures_with_padded_rows_are_decoded(
    name: str, channels: int, depth: int, view: View
) -> None:
    step = 16 * channels * depth + 5
    content = memoryview(bytes([128]) * (step * 10))

    pixels, size = decode(Encoded("raw", content, (16, 10, step, name)), view)

    assert size == (16, 10)
    assert pixels.shape == ((10, 16) if view.is_grey else (10, 16, 3))
    assert np.abs(pixels.astype(int) - 128).max() <= 1


def test_oversized_picture_is_refused_by_its_header() -> None:
    png = bytearray(_encode(_ramp(), ".png").content)
    png[16:24] = struct.pack(">II", 60_000, 60_000)
    png[29:33] = struct.pack(">I", zlib.crc32(bytes(png[12:29])))

    with pytest.raises(LogTooLargeError, match=f"60000 x 60000 pixels: more than {MAX_PIXELS:,}"):
        decode(Encoded("png", memoryview(bytes(png))), COLOUR)
    jpeg = bytearray(_encode(_ramp(), ".jpg").content)
    frame = jpeg.index(b"\xff\xc0")
    jpeg[frame + 5 : frame + 9] = struct.pack(">HH", 65_000, 65_000)
    with pytest.raises(LogTooLargeError, match="65000 x 65000"):
        decode(Encoded("jpeg", memoryview(bytes(jpeg))), COLOUR)
    with pytest.raises(LogTooLargeError, match="100000 x 100000"):
        decode(Encoded("raw", memoryview(b"0"), (100_000, 100_000, 100_000, "mono8")), GREY)


@given(
    where=st.integers(0, 100_000),
    flip=st.integers(1, 255),
    suffix=st.sampled_from([".png", ".jpg", ".webp"]),
)
def test_damaged_picture_is_refused_or_decoded(where: int, flip: int, suffix: str) -> None:
    whole = _encode(_ramp(), suffix)
    damaged = bytearray(whole.content)
    damaged[where % len(damaged)] ^= flip

    try:
        pixels, (width, height) = decode(Encoded(whole.coding, memoryview(bytes(damaged))), GREY)
    except LogError:
        return
    assert pixels.dtype == np.uint8
    assert pixels.shape == (height, width)


SIZE = (640, 360)
PLAIN = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)


@given(frames=st.integers(0, 40), max_count=st.integers(0, 9))
def test_pictures_are_evenly_spaced_over_the_drive(frames: int, max_count: int) -> None:
    _, coded = cv2.imencode(".jpg", PLAIN[:16, :16])
    with TemporaryDirectory() as name:
        drawer = Drawer(Path(name) / "pictures", max_count)
        for t_ns in range(frames):
            picture = Encoded("jpeg", memoryview(coded.tobytes()))
            drawer(t_ns, picture, ())
        drawn = sorted(int(path.stem) for path in Path(name).glob("pictures/*"))

    assert len(drawn) <= max_count
    assert len(drawn) >= min(frames, (max_count + 1) // 2)
    assert (
        drawn == list(range(0, frames, drawn[1] if len(drawn) > 1 else max(frames, 1)))[:max_count]
    )
