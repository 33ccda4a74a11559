"""A drafted vehicle file quotes the names of topics and includes the camera's calibration."""

import tomllib
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.columns import Block, Table, Topic
from crosscue.replay.vehicle.drafting.camera import CameraMounting
from crosscue.replay.vehicle.drafting.text import _quoted, draft_text, examine
from support.memory_log import MemoryLog


@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_quoted_name_round_trips_and_is_printable(name: str) -> None:
    text = _quoted(name)

    assert tomllib.loads(f"name = {text}") == {"name": name}
    assert text.isprintable()


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
