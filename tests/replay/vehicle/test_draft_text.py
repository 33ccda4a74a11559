"""A drafted vehicle file quotes the names of topics and includes the camera's calibration."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.columns import Block, Table, Topic
from crosscue.replay.vehicle.drafting.camera import CameraMounting, camera_lines
from crosscue.replay.vehicle.drafting.text import _quoted, draft_text, examine
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

    lines = camera_lines([MemoryLog(topics, [block])], CameraMounting())

    camera = tomllib.loads("\n".join(lines))["camera"]
    assert (camera["focal_px"], camera["center_px"]) == (900.0, [640.0, 360.0])
    assert camera.get("size_px") == (list(size_px) if all(size_px) else None)


def speed_log(**columns_of: str) -> MemoryLog:
    """A log with a GNSS and one table per topic, whose column has the speed of a car that stops."""
    t_ns = np.arange(0, 60 * 10**9, 10**8)
    speed_mps = 12.0 + 8.0 * np.sin(t_ns * 2e-10)
    fixes = {"speed_mps": speed_mps, "course_rad": np.zeros(len(t_ns))}
    blocks = [Block("gnss", t_ns, Table({**fixes, "latitude_deg": np.full(len(t_ns), 52.0)}))]
    topics = [Topic("gnss", "sensor_msgs/msg/NavSatFix", "columns")]
    for name, column in columns_of.items():
        topics.append(Topic(name, "crosscue/Table", "columns"))
        scale = 3.6 if name == "in_kmph" else 1.0
        columns = {column: scale * speed_mps}
        if name == "position":
            columns["latitude_deg"] = np.full(len(t_ns), 52.0)
        blocks.append(Block(name, t_ns, Table(columns)))
    return MemoryLog(tuple(topics), blocks)


def drafted(log: MemoryLog) -> tuple[str, dict[str, str]]:
    text = draft_text(examine([log], ()), Path(), CameraMounting())
    return text, tomllib.loads(text).get("topics", {})


def test_table_with_the_speed_of_the_car_becomes_the_odometry() -> None:
    """A table of GNSS and one of another column are not the car's speed."""
    text, topics = drafted(
        speed_log(position="speed_mps", radar="relative_speed_mps", car="speed_mps")
    )

    assert topics["odometry"] == "car"
    assert "# The vehicle speed, of no axle: 10 Hz, 4.0 to 20.0 m/s" in text
    assert "# or:" not in text
    text, topics = drafted(speed_log(b="speed_mps", a="speed_x_mps"))
    assert topics["odometry"] == "a"
    assert 'odometry = "a"  # or: b' in text


def test_speed_that_contradicts_gnss_is_listed_and_not_chosen() -> None:
    text, topics = drafted(speed_log(in_kmph="speed_mps"))

    assert "odometry" not in topics
    assert "# not chosen: in_kmph: WRONG: contradicts it; 10 Hz, 14.4 to 72.0 m/s" in text


def test_table_is_not_searched_where_a_topic_has_wheel_speeds() -> None:
    log = speed_log(car="speed_mps")
    wheels = Block("wheels", np.arange(9), Table({"rear_left_mps": np.full(9, 8.0)}))
    topics = (*log.topics, Topic("wheels", "crosscue/WheelSpeeds", "columns"))

    text, found = drafted(MemoryLog(topics, [*log.blocks, wheels]))

    assert "odometry" not in found
    assert "vehicle speed" not in text
