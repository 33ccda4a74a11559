"""Where in a ROS message the parts of a vector or a quaternion lie."""

from __future__ import annotations


def xyz(columns: str, path: str) -> dict[str, str]:
    """From column to field for the parts of a vector; ``columns`` has {} for the axis."""
    return {columns.format(axis): f"{path}.{axis}" for axis in "xyz"}


def quat(path: str) -> dict[str, str]:
    """The same for a quaternion."""
    return {f"quat_{axis}": f"{path}.{axis}" for axis in "xyzw"}
