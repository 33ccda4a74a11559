"""Tests of pictures with drawn detections, road and cues."""

from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from crosscue.detectors.images import Encoded
from crosscue.detectors.overlay import Drawer

SIZE = (640, 360)
GREY = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)


@given(frames=st.integers(0, 40), max_count=st.integers(0, 9))
def test_pictures_are_evenly_spaced_over_the_drive(frames: int, max_count: int) -> None:
    _, coded = cv2.imencode(".jpg", GREY[:16, :16])
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
