"""Paths of the components of a vector or a quaternion in a ROS message."""


def xyz(columns: str, path: str) -> dict[str, str]:
    """Map columns to the fields of a vector's components; ``columns`` has {} for the axis."""
    return {columns.format(axis): f"{path}.{axis}" for axis in "xyz"}


def quat(path: str) -> dict[str, str]:
    """Map columns to the fields of a quaternion's components."""
    return {f"quat_{axis}": f"{path}.{axis}" for axis in "xyzw"}
