"""Spelling of message types."""


def ros2_spelling(type_name: str) -> str:
    """Convert ``sensor_msgs/Imu`` to ``sensor_msgs/msg/Imu``; leave other names unchanged."""
    parts = type_name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 and parts[0] != "crosscue" else type_name
