"""A simulated nuScenes scene in the published schema, with the CAN expansion."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from support.pictures import picture

FIRST_US: Final = 1_532_402_927_612_460
SPEED_MPS: Final = 6.0
YAW_RATE_RADPS: Final = 0.1
SIZE_PX: Final = (1600, 900)
FOCAL_PX: Final = 1266.0
WHEEL_RADIUS_M: Final = 0.305
CAMERA_M: Final = (1.7, 0.0, 1.5)
# Rotation from the camera's axes (right, down, ahead) to the vehicle's (ahead, left, up).
OF_CAMERA: Final = (0.5, -0.5, 0.5, -0.5)


def pose(seconds: float) -> tuple[float, float, float]:
    """East, north and heading of the rear axle."""
    yaw = YAW_RATE_RADPS * seconds
    radius = SPEED_MPS / YAW_RATE_RADPS
    return 600.0 + radius * math.sin(yaw), 1600.0 + radius * (1.0 - math.cos(yaw)), yaw


def turn_wxyz(yaw: float) -> list[float]:
    """Quaternion of a rotation about z."""
    return [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]


def table(folder: Path, name: str, rows: Sequence[Mapping[str, object]]) -> None:
    """Write a table as in the published files, with each key on a separate line."""
    (folder / f"{name}.json").write_text(json.dumps(rows, indent=0))


def nuscenes_drive(path: Path, count: int = 12, *, with_can: bool = True, scenes: int = 1) -> Path:
    """Write a data root with one scene of ``count`` pictures at 10 Hz, every fifth a key frame."""
    tables = path / "v1.0-mini"
    tables.mkdir(parents=True)
    names = [f"scene-{61 + i:04d}" for i in range(scenes)]
    table(tables, "scene", [{"token": f"s{i}", "name": name} for i, name in enumerate(names)])
    table(
        tables,
        "sensor",
        [
            {"token": "cam", "channel": "CAM_FRONT", "modality": "camera"},
            {"token": "lid", "channel": "LIDAR_TOP", "modality": "lidar"},
        ],
    )
    matrix = [[FOCAL_PX, 0.0, 816.0], [0.0, FOCAL_PX, 491.0], [0.0, 0.0, 1.0]]
    table(
        tables,
        "calibrated_sensor",
        [
            {
                "token": "ccam",
                "sensor_token": "cam",
                "translation": CAMERA_M,
                "rotation": OF_CAMERA,
                "camera_intrinsic": matrix,
            },
            {
                "token": "clid",
                "sensor_token": "lid",
                "translation": [0.9, 0.0, 1.8],
                "rotation": [1.0, 0.0, 0.0, 0.0],
                "camera_intrinsic": [],
            },
        ],
    )
    samples, data, poses = [], [], []
    for i in range(count):
        t_us = FIRST_US + 100_000 * i
        is_key = i % 5 == 0
        if is_key:
            samples.append(
                {"token": f"p{i}", "timestamp": t_us, "scene_token": "s0", "prev": "", "next": ""}
            )
        east, north, yaw = pose(0.1 * i)
        poses.append(
            {
                "token": f"e{i}",
                "timestamp": t_us,
                "translation": [east, north, 0.0],
                "rotation": turn_wxyz(yaw),
            }
        )
        folder = "samples" if is_key else "sweeps"
        name = f"{folder}/CAM_FRONT/{t_us}.png"
        data.append(
            {
                "token": f"d{i}",
                "sample_token": f"p{i - i % 5}",
                "ego_pose_token": f"e{i}",
                "calibrated_sensor_token": "ccam",
                "timestamp": t_us,
                "fileformat": "png",
                "is_key_frame": is_key,
                "height": SIZE_PX[1],
                "width": SIZE_PX[0],
                "filename": name,
                "prev": "",
                "next": "",
            }
        )
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(picture(i))
    table(tables, "sample", samples)
    table(tables, "sample_data", data)
    table(tables, "ego_pose", poses)
    _boxes(tables, count)
    if with_can:
        _can(path, count)
    return path


def _boxes(tables: Path, count: int) -> None:
    """Write boxes: a parked car 20 m ahead of the first pose, a pedestrian, and a car behind."""
    table(
        tables,
        "attribute",
        [
            {"token": "a1", "name": "vehicle.parked"},
            {"token": "a2", "name": "vehicle.moving"},
            {"token": "a3", "name": "pedestrian.moving"},
        ],
    )
    table(
        tables,
        "category",
        [
            {"token": "k1", "name": "vehicle.car"},
            {"token": "k2", "name": "human.pedestrian.adult"},
        ],
    )
    table(
        tables,
        "instance",
        [
            {"token": "i1", "category_token": "k1"},
            {"token": "i2", "category_token": "k2"},
        ],
    )
    rows = []
    for i in range(0, count, 5):
        rows += [
            {
                "token": f"b{i}",
                "sample_token": f"p{i}",
                "instance_token": "i1",
                "visibility_token": "4",
                "attribute_tokens": ["a1"],
                "translation": [620.0, 1603.0, 0.8],
                "size": [1.9, 4.5, 1.6],
                "rotation": turn_wxyz(0.0),
            },
            {
                "token": f"w{i}",
                "sample_token": f"p{i}",
                "instance_token": "i2",
                "visibility_token": "1",
                "attribute_tokens": ["a3"],
                "translation": [640.0, 1600.0, 0.9],
                "size": [0.6, 0.7, 1.8],
                "rotation": turn_wxyz(1.0),
            },
            {
                "token": f"v{i}",
                "sample_token": f"p{i}",
                "instance_token": "i1",
                "visibility_token": "",
                "attribute_tokens": [],
                "translation": [590.0, 1600.0, 0.9],
                "size": [1.9, 4.5, 1.6],
                "rotation": turn_wxyz(0.0),
            },
        ]
    table(tables, "sample_annotation", rows)


def _can(path: Path, count: int) -> None:
    """Write CAN messages; steering is positive to the right, wheel speeds are in rpm."""
    folder = path / "can_bus"
    folder.mkdir()
    wheels, steering, imu = [], [], []
    for i in range(10 * count):
        utime = FIRST_US + 10_000 * i
        rpm = {
            f"{wheel}_wheel_speed": (SPEED_MPS + side * 0.75 * YAW_RATE_RADPS)
            * 60
            / (2 * math.pi * WHEEL_RADIUS_M)
            for wheel, side in (("FL", -1), ("FR", 1), ("RL", -1), ("RR", 1))
        }
        wheels.append({"utime": utime, "odom_speed": 21.6, **rpm})
        steering.append({"utime": utime, "value": -0.7})
        imu.append(
            {
                "utime": utime,
                "linear_accel": [0.0, 0.6, 9.81],
                "q": [1.0, 0.0, 0.0, 0.0],
                "rotation_rate": [0.0, 0.0, YAW_RATE_RADPS],
            }
        )
    for name, rows in (("zoe_veh_info", wheels), ("steeranglefeedback", steering), ("ms_imu", imu)):
        (folder / f"scene-0061_{name}.json").write_text(json.dumps(rows))
