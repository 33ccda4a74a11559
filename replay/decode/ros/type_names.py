"""How message types are spelt."""

from __future__ import annotations


def ros2_spelling(type_name: str) -> str:
    """``sensor_msgs/Imu`` as ``sensor_msgs/msg/Imu``; other names stay as they are."""
    parts = type_name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 and parts[0] != "crosscue" else type_name
