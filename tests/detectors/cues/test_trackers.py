"""Tests of crossing and parked cars by the dissertation's rules for pairs of detections."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.detectors import rle
from crosscue.detectors.base import Detections
from crosscue.detectors.cues.cars import (
    CarShapes,
    car_shapes,
    cross_traffic,
    pair_cars,
    parked_cars,
)
from crosscue.detectors.cues.observed import Sides
from crosscue.replay.vehicle.vehicle import Cars

SIZE = (400, 200)
RULES = Cars(score=0.95)


def _car(
    x: int, nose: int, t_ns: int, y: int = 60, length: int = 90, score: float = 0.99
) -> Detections:
    """Build a car with a lower end (its nose) at the left (-1) or right (1)."""
    height = 30
    profile = np.full(length, height)
    quarter = length // 3
    profile[:quarter] = 18 if nose < 0 else height
    profile[-quarter:] = 18 if nose > 0 else height
    mask = np.arange(height)[:, None] >= height - profile[None, :]
    box = np.array([[x, y, x + length, y + height]], np.float64)
    text = rle.encode_mask(mask, (x, y), SIZE)
    return Detections(t_ns, SIZE, box, np.array([score]), ("car",), (text,))


def _shapes(*cars: Detections) -> CarShapes:
    return car_shapes(cars, RULES)


def _mirrored(found: Detections) -> Detections:
    width = SIZE[0]
    x0, y0, x1, y1 = found.boxes_px[0]
    mask = rle.decode_mask(found.masks[0], SIZE)[:, ::-1]
    box = np.array([[width - x1, y0, width - x0, y1]])
    return replace(found, boxes_px=box, masks=(rle.encode_mask(mask, (0, 0), SIZE),))


def _sides(before: CarShapes, now: CarShapes) -> tuple[Sides, Sides]:
    pairs = pair_cars(before, now, RULES)
    return cross_traffic(pairs, RULES), parked_cars(pairs, RULES)


@pytest.mark.parametrize(("nose", "expected"), [(-1, Sides(1, 0)), (1, Sides(0, 1))])
def test_parked_car_counts_on_the_side_of_its_nose(nose: int, expected: Sides) -> None:
    before, now = _shapes(_car(200, nose, 0)), _shapes(_car(200, nose, 10**8))

    assert _sides(before, now) == (Sides(0, 0), expected)


@given(
    x=st.integers(60, 220),
    dx=st.integers(-25, 25),
    dy=st.integers(-8, 8),
    nose=st.sampled_from([-1, 1]),
)
def test_mirrored_pair_counts_on_the_other_side(x: int, dx: int, dy: int, nose: int) -> None:
    before, now = _car(x, nose, 0), _car(x + dx, nose, 10**8, y=60 + dy)

    seen = _sides(_shapes(before), _shapes(now))
    mirrored = _sides(_shapes(_mirrored(before)), _shapes(_mirrored(now)))

    assert [Sides(s.right, s.left) for s in seen] == list(mirrored)


@given(
    h=st.integers(1, 12),
    w=st.integers(1, 12),
    x=st.integers(0, 6),
    y=st.integers(0, 6),
    seed=st.integers(0, 999),
)
def test_run_length_encoding_survives_a_round_trip(
    h: int, w: int, x: int, y: int, seed: int
) -> None:
    mask = np.random.default_rng(seed).random((h, w)) < 0.6
    size = (w + x + seed % 3, h + y + seed % 2)
    whole = np.zeros((size[1], size[0]), np.bool_)
    whole[y : y + h, x : x + w] = mask

    text = rle.encode_mask(mask, (x, y), size)

    assert (rle.decode_mask(text, size) == whole).all()
    assert rle.area_px(text) == whole.sum()
    np.testing.assert_allclose(rle.column_heights_px(text, size), whole.sum(axis=0))


def test_run_length_encoding_matches_coco() -> None:
    corner = np.array([[True]])

    assert rle.encode_mask(corner, (0, 0), (2, 2)) == b"013"  # none, one, three
    # 40 = 8 + 32: five bits "8" with the continuation bit (8 + 32 + 48 = 'X'), then 1 ('1').
    assert rle.encode_mask(corner, (0, 40), (1, 41)) == b"X11"


@given(st.lists(st.integers(0, 2**30), min_size=1, max_size=40))
def test_runs_are_joined_from_their_groups_of_five_bits(lengths: list[int]) -> None:
    text = rle._to_text(np.array(lengths, np.int64))
    values, value, bits = list[int](), 0, 0
    for code in (byte - 48 for byte in text):
        value, bits = value | (code & 31) << bits, bits + 5
        if not code & 32:
            signed = value - (1 << bits if code & 16 else 0)
            values.append(signed + (values[-2] if len(values) > 2 else 0))
            value, bits = 0, 0

    assert rle.runs(text).tolist() == values == lengths


def test_a_run_of_more_than_seven_groups_is_refused() -> None:
    assert rle.runs(b"o" * 6 + b"0").tolist() == [2**30 - 1]
    with pytest.raises(ValueError, match="a run is too long"):
        rle.runs(b"o" * 7 + b"0")


def test_mask_outside_its_picture_is_refused() -> None:
    with pytest.raises(ValueError, match="not inside 4 x 4"):
        rle.encode_mask(np.ones((2, 2), np.bool_), (3, 0), (4, 4))


@pytest.mark.parametrize("size", [(8, 9), (8, 7), (9, 8)])
def test_mask_of_another_picture_size_is_refused(size: tuple[int, int]) -> None:
    full = rle.encode_mask(np.ones((8, 8), np.bool_), (0, 0), (8, 8))

    for read in (rle.decode_mask, rle.column_heights_px):
        with pytest.raises(ValueError, match="mask of 64 pixels"):
            read(full, size)


@pytest.mark.parametrize("text", [b"", b"\x00", b"o", b"zzzz", b"0" * 3 + b"\xff"])
def test_invalid_mask_bytes_are_refused(text: bytes) -> None:
    with pytest.raises(ValueError, match="mask"):
        rle.decode_mask(text, (8, 8))
