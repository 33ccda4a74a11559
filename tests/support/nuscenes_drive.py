"""A simulated nuScenes scene in the published schema, with the CAN expansion."""

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from support.pictures import picture
from support.street_map import Bound, crossing_lanes

COUNT: Final = 12
FIRST_US: Final = 1_532_402_927_612_460
SPEED_MPS: Final = 6.0
YAW_RATE_RADPS: Final = 0.1
SIZE_PX: Final = (1600, 900)
FOCAL_PX: Final = 1266.0
WHEEL_RADIUS_M: Final = 0.305
LOCATION: Final = "boston-seaport"
CAMERA_M: Final = (1.7, 0.0, 1.5)
# Rotation from the camera's axes (right, down, ahead) to the vehicle's (ahead, left, up).
OF_CAMERA: Final = (0.5, -0.5, 0.5, -0.5)


def pose(seconds: float) -> tuple[float, float, float]:
    """East, north and heading of the rear axle."""
    yaw = YAW_RATE_RADPS * seconds
    radius = SPEED_MPS / YAW_RATE_RADPS
    return 600.0 + radius * math.sin(yaw), 1600.0 + radius * (1.0 - math.cos(yaw)), yaw


def turn_wxyz(yaw: float) -> list[float]:
    return [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]


def table(folder: Path, name: str, keys: str, rows: Iterable[Sequence[object]]) -> None:
    """Write a table as in the published files, with each key on a separate line."""
    content = [dict(zip(keys.split(), row, strict=True)) for row in rows]
    (folder / f"{name}.json").write_text(json.dumps(content, indent=0))


def nuscenes_drive(path: Path, scenes: int = 1) -> Path:
    """Write a data root with one scene of 12 pictures at 10 Hz, every fifth a key frame."""
    tables = path / "v1.0-mini"
    tables.mkdir(parents=True)
    names = [f"scene-{61 + i:04d}" for i in range(scenes)]
    scene_rows = [(f"s{i}", name, "l0") for i, name in enumerate(names)]
    table(tables, "scene", "token name log_token", scene_rows)
    table(tables, "log", "token location", [("l0", LOCATION)])
    sensors = [("cam", "CAM_FRONT", "camera"), ("lid", "LIDAR_TOP", "lidar")]
    table(tables, "sensor", "token channel modality", sensors)
    matrix = [[FOCAL_PX, 0.0, 816.0], [0.0, FOCAL_PX, 491.0], [0.0, 0.0, 1.0]]
    table(
        tables,
        "calibrated_sensor",
        "token sensor_token translation rotation camera_intrinsic",
        [
            ("ccam", "cam", CAMERA_M, OF_CAMERA, matrix),
            ("clid", "lid", [0.9, 0.0, 1.8], [1.0, 0.0, 0.0, 0.0], []),
        ],
    )
    times_us = [FIRST_US + 100_000 * i for i in range(COUNT)]
    keys = range(0, COUNT, 5)
    samples = [(f"p{i}", times_us[i], "s0", "", "") for i in keys]
    table(tables, "sample", "token timestamp scene_token prev next", samples)
    data, poses = [], []
    for i, t_us in enumerate(times_us):
        east, north, yaw = pose(0.1 * i)
        poses.append((f"e{i}", t_us, [east, north, 0.0], turn_wxyz(yaw)))
        name = f"{'samples' if i in keys else 'sweeps'}/CAM_FRONT/{t_us}.png"
        tokens = (f"d{i}", f"p{i - i % 5}", f"e{i}", "ccam")
        data.append((*tokens, t_us, "png", i in keys, *SIZE_PX[::-1], name, "", ""))
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(picture(i))
    columns = "timestamp fileformat is_key_frame height width filename prev next"
    references = "token sample_token ego_pose_token calibrated_sensor_token"
    table(tables, "sample_data", f"{references} {columns}", data)
    table(tables, "ego_pose", "token timestamp translation rotation", poses)
    _boxes(tables, keys)
    _can(path)
    return path


def write_expansion(path: Path) -> Path:
    """Write a map expansion with a crossing 40 m ahead of the first pose, and return its path.

    A traffic light's stop line lies over the end of the lane that the car is in.
    """
    tree: dict[str, Any] = {"version": "1.3", "node": [], "polygon": [], "lane": []}
    tree |= {"lane_connector": [], "arcline_path_3": {}, "connectivity": {}, "stop_line": []}

    def polygon(token: str, corners: Bound) -> str:
        names = [f"{token}-{i}" for i in range(len(corners))]
        tree["node"] += [
            {"token": name, "x": 580.0 + x, "y": 1601.75 + y}
            for name, (x, y) in zip(names, corners, strict=True)
        ]
        row = {"token": f"{token}-p", "exterior_node_tokens": names, "holes": []}
        tree["polygon"].append(row)
        return f"{token}-p"

    lanes = crossing_lanes()
    for token, (left, right, _) in lanes.items():
        is_lane = token.endswith(("-in", "-out"))
        area = polygon(token, [*left, *right[::-1]])
        row = {"token": token, "polygon_token": area}
        if is_lane:
            tree["lane"].append(row | {"lane_type": "CAR"})
        else:
            tree["lane_connector"].append({"token": token})
        (x0, y0), (x1, y1) = (
            (580.0 + (a[0] + b[0]) / 2, 1601.75 + (a[1] + b[1]) / 2)
            for a, b in ((left[0], right[0]), (left[-1], right[-1]))
        )
        yaw, length = math.atan2(y1 - y0, x1 - x0), math.hypot(x1 - x0, y1 - y0)
        piece: dict[str, Any] = {
            "start_pose": [x0, y0, yaw],
            "end_pose": [x1, y1, yaw],
            "shape": "LSR",
        }
        piece |= {"radius": 999.999, "segment_length": [0.0, length, 0.0]}
        tree["arcline_path_3"][token] = [piece]
        arm, to = token.split("-")
        before = [] if is_lane else [f"{arm}-in"]
        after = [] if is_lane else [f"{to}-out"]
        if to == "in":
            after = [one for one in lanes if one.startswith(f"{arm}-") and one[-1] in "wens"]
            after = [one for one in after if not one.endswith(("-in", "-out"))]
        if to == "out":
            before = [one for one in lanes if one.endswith(f"-{arm}")]
        tree["connectivity"][token] = {"incoming": before, "outgoing": after}
    area = polygon("stop", [(53.0, -3.4), (55.0, -3.4), (55.0, -0.1), (53.0, -0.1)])
    stop = {"token": "stop", "polygon_token": area, "stop_line_type": "TRAFFIC_LIGHT"}
    tree["stop_line"].append(stop)
    place = path / "maps" / "expansion" / f"{LOCATION}.json"
    place.parent.mkdir(parents=True)
    place.write_text(json.dumps(tree))
    return place


def _boxes(tables: Path, keys: Iterable[int]) -> None:
    """Write boxes: a parked car 20 m ahead of the first pose, a pedestrian, and a car behind."""
    names = ("vehicle.parked", "vehicle.moving", "pedestrian.moving")
    table(tables, "attribute", "token name", [(f"a{i}", name) for i, name in enumerate(names, 1)])
    kinds = [("k1", "vehicle.car"), ("k2", "human.pedestrian.adult")]
    table(tables, "category", "token name", kinds)
    table(tables, "instance", "token category_token", [("i1", "k1"), ("i2", "k2")])
    # Instance, visibility, attributes, place, size and yaw, by the first letter of the token.
    boxes: dict[str, tuple[str, str, list[str], list[float], list[float], float]] = {
        "b": ("i1", "4", ["a1"], [620.0, 1603.0, 0.8], [1.9, 4.5, 1.6], 0.0),
        "w": ("i2", "1", ["a3"], [640.0, 1600.0, 0.9], [0.6, 0.7, 1.8], 1.0),
        "v": ("i1", "", [], [590.0, 1600.0, 0.9], [1.9, 4.5, 1.6], 0.0),
    }
    table(
        tables,
        "sample_annotation",
        "token sample_token instance_token visibility_token attribute_tokens translation size "
        "rotation",
        [
            (f"{letter}{i}", f"p{i}", *box, turn_wxyz(yaw))
            for i in keys
            for letter, (*box, yaw) in boxes.items()
        ],
    )


def _can(path: Path) -> None:
    """Write CAN messages; steering is positive to the right, wheel speeds are in rpm."""
    folder = path / "can_bus"
    folder.mkdir()
    per_mps = 60 / (2 * math.pi * WHEEL_RADIUS_M)
    rpm = [
        (SPEED_MPS + side * 0.75 * YAW_RATE_RADPS) * per_mps
        for side in (-1, 1, -1, 1)  # front left and right, rear left and right
    ]
    times = [FIRST_US + 10_000 * i for i in range(10 * COUNT)]
    wheels = "FL_wheel_speed FR_wheel_speed RL_wheel_speed RR_wheel_speed"
    turn, still = [0.0, 0.0, YAW_RATE_RADPS], [1.0, 0.0, 0.0, 0.0]
    for name, keys, row in (
        ("zoe_veh_info", f"odom_speed {wheels}", (21.6, *rpm)),
        ("steeranglefeedback", "value", (-0.7,)),
        ("ms_imu", "linear_accel q rotation_rate", ([0.0, 0.6, 9.81], still, turn)),
    ):
        table(folder, f"scene-0061_{name}", f"utime {keys}", [(utime, *row) for utime in times])
