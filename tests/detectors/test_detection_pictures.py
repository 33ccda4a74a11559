"""Tests of pictures with drawn detections, road and cues."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.detectors import rle
from crosscue.detectors.base import Detections, RoadMask
from crosscue.detectors.images import Encoded
from crosscue.detectors.overlay import BLUE, GREEN, Drawer, draw_detections

SIZE = (640, 360)
GREY = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)


def _drawn(
    found: tuple[Detections | RoadMask, ...], cues: dict[str, int], enlarge: float = 1.0
) -> np.typing.NDArray[np.uint8]:
    return draw_detections(GREY, found, cues, enlarge)


def test_only_the_outline_of_a_box_is_drawn() -> None:
    box = np.array([[100.0, 200.0, 180.0, 260.0]])
    found = Detections(0, SIZE, box, np.ones(1), ("car",), (b"",))

    drawn = _drawn((found,), {})

    assert (drawn[230, [100, 180]] == GREEN).all()
    assert (drawn[[200, 260], 140] == GREEN).all()
    assert (drawn[205:255, 105:175] == 128).all()
    assert (GREY == 128).all()


def test_only_road_is_tinted() -> None:
    mask = np.zeros((36, 64), np.bool_)
    mask[18:30, :32] = True
    road = RoadMask(0, SIZE, rle.encode_mask(mask, (0, 0), (64, 36)), (64, 36))

    drawn = _drawn((road,), {})

    assert (drawn[190:290, 5:315] == np.array(BLUE) // 2 + 64).all()
    assert (drawn[30:330, 325:] == 128).all()


@given(frames=st.integers(0, 40), max_count=st.integers(0, 9))
@settings(max_examples=40, deadline=None)
def test_pictures_are_evenly_spaced_over_the_drive(frames: int, max_count: int) -> None:
    _, coded = cv2.imencode(".jpg", GREY[:16, :16])
    with TemporaryDirectory() as name:
        drawer = Drawer(Path(name) / "pictures", max_count)
        for t_ns in range(frames):
            picture = Encoded("jpeg", memoryview(coded.tobytes()))
            drawer(t_ns, picture, (), {})
        drawn = sorted(int(path.stem) for path in Path(name).glob("pictures/*"))

    assert len(drawn) <= max_count
    assert len(drawn) >= min(frames, (max_count + 1) // 2)
    assert (
        drawn == list(range(0, frames, drawn[1] if len(drawn) > 1 else max(frames, 1)))[:max_count]
    )
