"""A drafted vehicle file quotes the names of topics and includes the camera's calibration."""

import tomllib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.base import Block, Table, Topic
from crosscue.replay.vehicle.drafting.camera import Mounting, camera_lines
from crosscue.replay.vehicle.drafting.text import _quoted
from support.memory_log import MemoryLog


@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_quoted_name_round_trips_and_is_printable(name: str) -> None:
    text = _quoted(name)

    assert tomllib.loads(f"name = {text}") == {"name": name}
    assert text.isprintable()


@pytest.mark.parametrize("size_px", [(1280, 720), (0, 0)])
def test_image_size_is_drafted_only_if_the_log_records_it(
    size_px: tuple[int, int],
) -> None:
    k = np.array([[900.0, 0.0, 640.0, 0.0, 900.0, 360.0, 0.0, 0.0, 1.0]])
    columns = {"width_px": np.array([size_px[0]]), "height_px": np.array([size_px[1]]), "k": k}
    block = Block("/info", np.zeros(1, np.int64), Table(columns))
    topics = (
        Topic("/image", "sensor_msgs/msg/Image", "columns"),
        Topic("/info", "sensor_msgs/msg/CameraInfo", "columns"),
    )

    lines = camera_lines([MemoryLog(topics, [block])], Mounting())

    camera = tomllib.loads("\n".join(lines))["camera"]
    assert (camera["focal_px"], camera["center_px"]) == (900.0, [640.0, 360.0])
    assert camera.get("size_px") == (list(size_px) if all(size_px) else None)
