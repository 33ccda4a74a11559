"""Roles of topics by their message types."""

from collections.abc import Mapping
from enum import Enum
from typing import Final

from crosscue.replay.columns import Topic
from crosscue.replay.decode.ros.type_names import ros2_spelling


class Role(Enum):
    """The role of a stream in a run."""

    CAMERA = "camera"
    CAMERA_INFO = "camera calibration"
    CAN = "CAN bus"
    MOBILEYE = "Mobileye"
    IMU = "inertial unit"
    MAGNETOMETER = "magnetometer"
    GNSS = "GNSS"
    ODOMETRY = "odometry"
    POSE = "pose"
    WHEELS = "wheel speeds"


# Roles by type name in ROS 2 spelling; ``ros2_spelling`` converts ROS 1 names.
BY_TYPE: Final[Mapping[str, Role]] = {
    "sensor_msgs/msg/CompressedImage": Role.CAMERA,
    "sensor_msgs/msg/Image": Role.CAMERA,
    "foxglove.CompressedImage": Role.CAMERA,
    "foxglove.CompressedVideo": Role.CAMERA,
    "foxglove.RawImage": Role.CAMERA,
    "foxglove_msgs/msg/CompressedImage": Role.CAMERA,
    "foxglove_msgs/msg/CompressedVideo": Role.CAMERA,
    "crosscue/Images": Role.CAMERA,
    "sensor_msgs/msg/CameraInfo": Role.CAMERA_INFO,
    "foxglove.CameraCalibration": Role.CAMERA_INFO,
    "can_msgs/msg/Frame": Role.CAN,
    "crosscue/CanFrames": Role.CAN,
    "sensor_msgs/msg/Imu": Role.IMU,
    "sensor_msgs/msg/MagneticField": Role.MAGNETOMETER,
    "sensor_msgs/msg/NavSatFix": Role.GNSS,
    "foxglove.LocationFix": Role.GNSS,
    "crosscue/WheelSpeeds": Role.WHEELS,
    "nav_msgs/msg/Odometry": Role.ODOMETRY,
    "geometry_msgs/msg/PoseStamped": Role.POSE,
}

# Types whose rows are plain columns: ``convert`` may change the type, but not the role.
OF_TABLES: Final[Mapping[str, Role | None]] = {
    "crosscue/Table": None,
    **{
        name: role
        for name, role in BY_TYPE.items()
        if role in (Role.IMU, Role.MAGNETOMETER, Role.GNSS, Role.ODOMETRY, Role.POSE, Role.WHEELS)
    },
}


def is_table(topic: Topic) -> bool:
    """Return whether a topic has plain columns and no role, so that a vehicle file may name it."""
    return (topic.converted_from or topic.type_name) == "crosscue/Table"


def role_of(topic: Topic) -> Role | None:
    """Return the role of ``topic`` without configuration, or None."""
    if topic.converted_from in OF_TABLES:
        return OF_TABLES[topic.converted_from]
    name = ros2_spelling(topic.type_name)
    if name.startswith("mobileye_560_660_msgs/"):
        return Role.MOBILEYE
    return BY_TYPE.get(name)
