"""Read a scene of nuScenes, with its CAN bus expansion, as a log.

A scene is named by an empty file next to the tables' folder, ``scene-0061.nuscenes``. The folder
itself (``DATAROOT`` with ``v1.0-.../*.json``) also names a scene if it contains only one. Tables
have the published schema and are read row by row; the CAN expansion is ``can_bus/NAME_*.json``.

Topics: one per camera (key frames and sweeps); ``can/wheel_speed`` (zoe_veh_info, rpm of a wheel
of 0.305 m); ``can/steering`` (steeranglefeedback, positive to the right as published, to the left
here); ``can/imu`` (ms_imu); ``can/vehicle_monitor``; ``can/zoesensors``; ``can/pose``. Without
wheel speeds of the CAN expansion, ``odometry`` is computed from the ego poses, which are the truth.
Laser and radar are not read.

The ego frame's origin is the centre of the rear axle, x ahead, y left. The layout is that of the
published schema (for the expansion nuscenes-devkit, python-sdk/nuscenes/can_bus/README.md). It was
implemented without access to a drive of the data set.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from crosscue.replay.columns import Floats, Int64s, Table, Topic
from crosscue.replay.errors import LogFormatError
from crosscue.replay.limits import Limits
from crosscue.replay.readers.held_rows import CameraDrive, HeldRows, Loss
from crosscue.replay.readers.images.files import PictureFiles
from crosscue.replay.readers.timed_files import TimedFiles
from crosscue.replay.seal.touched import Touched

from .nuscenes_tables import Row, RowsOf, checked, whole_table
from .published import camera_of, note_whole, odometry_of

# Wheel radius of the Renault Zoe, from nuscenes-devkit, can_bus_tutorial.ipynb ("Known Zoe wheel
# radius in meters"). An unloaded 195/55 R16 tyre has 0.3105 m, 2 % more than this loaded tyre. An
# earlier edition has 0.328, which is 8 % faster; ``crosscue fit odometry`` fits the scale of a
# drive.
WHEEL_RADIUS_M: Final = 0.305
RPM_TO_MPS: Final = WHEEL_RADIUS_M * 2.0 * math.pi / 60.0
DAMAGED_ROW: Final = "a damaged row"
FRONT: Final = "CAM_FRONT"


class Scene(NamedTuple):
    """A scene and the location of its tables.

    Attributes:
        name: Name, such as ``scene-0061``.
        token: Token of its row.
        root: Folder to which ``filename`` in tables is relative.
        tables: Folder of the tables.
    """

    name: str
    token: str
    root: Path
    tables: Path


def find_scene(path: Path) -> Scene:
    """Find the scene that a path names.

    Raises:
        LogFormatError: The scene does not exist, or the path does not select one of several.
    """
    root = path if path.is_dir() else path.parent
    folders = sorted(file.parent for file in root.glob("v1.0-*/scene.json"))
    if not folders:
        raise LogFormatError(f"{root}: no v1.0-.../scene.json; expected nuScenes' tables there")
    scenes = {
        str(row["name"]): Scene(str(row["name"]), token, root, folder)
        for folder in folders
        for token, row in whole_table(folder / "scene.json", "name").items()
    }
    if not path.is_dir():
        if path.stem not in scenes:
            raise LogFormatError(f"{path}: no scene {path.stem!r} in the tables; {_some(scenes)}")
        return scenes[path.stem]
    if len(scenes) != 1:
        raise LogFormatError(
            f"{path}: {len(scenes)} scenes; name one by an empty file: touch "
            f"{path / (next(iter(scenes)) + '.nuscenes')}; {_some(scenes)}"
        )
    return next(iter(scenes.values()))


def _some(scenes: dict[str, Scene]) -> str:
    names = sorted(scenes)
    return f"there are: {', '.join(names[:5])}{', ...' if len(names) > 5 else ''}"


@dataclass(frozen=True, slots=True, eq=False)
class SceneTables:
    """Tables of one scene's cameras.

    Attributes:
        scene: The scene.
        samples: Times of its samples in ns, by token.
        pictures: Rows of ``sample_data`` of cameras, by channel, in order of time.
        calibrated: Rows of ``calibrated_sensor``, by token.
        losses: Damaged rows.
        files: Files of the tables.
    """

    scene: Scene
    samples: dict[str, int]
    pictures: dict[str, list[Row]]
    calibrated: dict[str, Row]
    losses: tuple[tuple[str, str, int | None, str], ...]
    files: tuple[Path, ...]

    def calibration(self, channel: str) -> Row | None:
        """Return the calibration of a camera in this scene."""
        rows = self.pictures.get(channel)
        return self.calibrated.get(str(rows[0]["calibrated_sensor_token"])) if rows else None


def read_scene_tables(scene: Scene) -> SceneTables:
    """Read the rows of one scene.

    Raises:
        LogFormatError: A table is missing, or a table that all rows refer to is damaged.
    """
    folder = scene.tables
    sensors = whole_table(folder / "sensor.json", "channel", "modality")
    calibrated = whole_table(folder / "calibrated_sensor.json", "sensor_token")
    channels = {
        token: str(sensor["channel"])
        for token, row in calibrated.items()
        if (sensor := sensors.get(str(row.get("sensor_token")))) is not None
        and sensor.get("modality") == "camera"
    }
    samples_table = RowsOf(checked(folder / "sample.json"))
    samples = {
        str(row["token"]): int(row["timestamp"]) * 1000
        for row in samples_table
        if row.get("scene_token") == scene.token and _has(row, "token", "timestamp")
    }
    data_table = RowsOf(checked(folder / "sample_data.json"))
    pictures: dict[str, list[Row]] = {}
    for row in data_table:
        channel = channels.get(str(row.get("calibrated_sensor_token")))
        if channel is None or row.get("sample_token") not in samples:
            continue
        if _has(row, "timestamp", "filename", "token", "ego_pose_token"):
            pictures.setdefault(channel, []).append(row)
        else:
            data_table.damaged += 1
            data_table.first_damage = data_table.first_damage or str(row.get("token"))
    for rows in pictures.values():
        rows.sort(key=lambda row: int(row["timestamp"]))
    losses: list[tuple[str, str, int | None, str]] = [
        ("", f"{DAMAGED_ROW} of {table.path.name}", table.damaged, table.first_damage)
        for table in (samples_table, data_table)
        if table.damaged
    ]
    losses += [
        ("", f"{table.path.name} is cut", None, "its array does not end")
        for table in (samples_table, data_table)
        if table.is_cut
    ]
    names = ("scene", "sensor", "calibrated_sensor", "sample", "sample_data")
    files = tuple(folder / f"{name}.json" for name in names)
    return SceneTables(
        scene, samples, dict(sorted(pictures.items())), calibrated, tuple(losses), files
    )


def _has(row: Row, *keys: str) -> bool:
    return all(
        isinstance(row.get(key), int) if key == "timestamp" else isinstance(row.get(key), str)
        for key in keys
    )


class NuscenesDrive(CameraDrive):
    """One scene as a ``Log``."""

    format: Final = "nuscenes"

    def __init__(
        self,
        tables: SceneTables,
        path: Path,
        cameras: Sequence[PictureFiles],
        rows: Sequence[HeldRows],
        limits: Limits,
        touched: Touched,
        unreadable: Sequence[tuple[str, str, int | None, str]],
    ) -> None:
        """Build a scene from the tables of its cameras."""
        super().__init__(
            path,
            cameras,
            rows,
            limits,
            touched,
            unreadable=unreadable,
            notices=("laser and radar are not read",),
        )
        self._tables: Final = tables

    def intrinsics(self, camera: str) -> tuple[float, float, float] | None:
        """Return focal length and optical center of a camera, px.

        Raises:
            LogFormatError: Its matrix is damaged.
        """
        row = self._tables.calibration(camera)
        if row is None:
            return None
        return matrix_of(row, self._tables.scene)


def matrix_of(row: Row, scene: Scene) -> tuple[float, float, float]:
    """Return focal length and optical center of a ``calibrated_sensor`` row.

    Raises:
        LogFormatError: They are not numbers of pixels.
    """
    try:
        matrix = np.array(row["camera_intrinsic"], np.float64)
        focal, x, y = float(matrix[0, 0]), float(matrix[0, 2]), float(matrix[1, 2])
    except (TypeError, KeyError, ValueError, IndexError):
        focal, x, y = math.nan, math.nan, math.nan
    if not (0.0 < focal < math.inf and math.isfinite(x) and math.isfinite(y)):
        raise LogFormatError(
            f"{scene.tables / 'calibrated_sensor.json'}: {row.get('token')}: camera_intrinsic: "
            "expected a matrix in pixels"
        )
    return focal, x, y


def open_scene(path: Path, limits: Limits) -> NuscenesDrive:
    """Open a scene; see ``crosscue.replay.formats.FORMATS``.

    Raises:
        LogFormatError: The scene does not exist, or has no camera.
    """
    tables = read_scene_tables(find_scene(path))
    scene, touched = tables.scene, Touched()
    note_whole(touched, *tables.files)
    cameras = [
        camera_of(channel, _timed(scene.root, rows), touched)
        for channel, rows in tables.pictures.items()
    ]
    unreadable = [*tables.losses]
    held = []
    for name, message in MESSAGES.items():
        file = scene.root / "can_bus" / f"{scene.name}_{name}.json"
        if not file.is_file():
            continue
        note_whole(touched, file)
        rows = _held(file, message)
        if isinstance(rows, HeldRows):
            held.append(rows)
        else:
            unreadable.append((message.topic, *rows))
    if not any(rows.topic.name == "can/wheel_speed" for rows in held) and cameras:
        held.append(_odometry(tables))
    if not cameras and not held:
        raise LogFormatError(f"{path}: {scene.name}: no picture of a camera in sample_data.json")
    return NuscenesDrive(tables, path, cameras, held, limits, touched, unreadable)


def _timed(root: Path, rows: Sequence[Row]) -> TimedFiles:
    places = [(root / str(row["filename"]), int(row["timestamp"]) * 1000) for row in rows]
    there = [(path, t_ns) for path, t_ns in places if path.is_file()]
    missing = [t_ns for path, t_ns in places if not path.is_file()]
    return TimedFiles(
        tuple(path for path, _ in there),
        np.array([t_ns for _, t_ns in there], np.int64),
        np.array(missing, np.int64),
        len(rows),
        (),
    )


class EgoPoses(NamedTuple):
    """Trajectory of the centre of the vehicle's rear axle.

    Attributes:
        t_ns: Times, shape (N,), int64.
        xyz_m: Positions in the map, shape (N, 3).
        wxyz: Quaternions from the vehicle's axes to the map's, shape (N, 4).
        losses: Damaged rows.
        declared: Expected number of poses.
    """

    t_ns: Int64s
    xyz_m: Floats
    wxyz: Floats
    losses: tuple[Loss, ...]
    declared: int


def ego_poses(tables: SceneTables) -> EgoPoses:
    """Return the poses at the pictures of the front camera, or of the first camera.

    Raises:
        LogFormatError: The table is missing, or contains fewer than two of them.
    """
    channel = FRONT if FRONT in tables.pictures else next(iter(tables.pictures), "")
    wanted = {str(row["ego_pose_token"]) for row in tables.pictures.get(channel, ())}
    table = RowsOf(checked(tables.scene.tables / "ego_pose.json"))
    found: dict[int, tuple[list[float], list[float]]] = {}
    bad = 0
    for row in table:
        if row.get("token") not in wanted:
            continue
        xyz, wxyz = numbers(row.get("translation"), 3), numbers(row.get("rotation"), 4)
        if xyz is None or wxyz is None or not isinstance(row.get("timestamp"), int):
            bad += 1
        else:
            found[int(row["timestamp"]) * 1000] = (xyz, wxyz)
    if len(found) < 2:
        raise LogFormatError(
            f"{table.path}: {len(found)} poses of {tables.scene.name}; expected more"
        )
    times = sorted(found)
    lost = len(wanted) - len(found)
    reason = f"{DAMAGED_ROW} of ego_pose.json"
    losses = (Loss(reason, lost, table.first_damage),) if bad or (lost and table.damaged) else ()
    return EgoPoses(
        np.array(times, np.int64),
        np.array([found[t_ns][0] for t_ns in times], np.float64),
        np.array([found[t_ns][1] for t_ns in times], np.float64),
        losses,
        len(wanted),
    )


def _odometry(tables: SceneTables) -> HeldRows:
    poses = ego_poses(tables)
    w, x, y, z = poses.wxyz.T
    heading = np.unwrap(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return odometry_of(poses.t_ns, poses.xyz_m[:, :2], ahead, poses.declared, poses.losses, heading)


def numbers(value: Any, count: int) -> list[float] | None:
    """Return ``count`` finite numbers, or None."""
    try:
        found = [float(one) for one in value]
    except (TypeError, ValueError):
        return None
    return found if len(found) == count and all(map(math.isfinite, found)) else None


_Columns = Callable[[Row], list[float]]


def _plain(*keys: str, scale: float = 1.0) -> _Columns:
    return lambda row: [scale * float(row[key]) for key in keys]


def _vectors(**sizes: int) -> _Columns:
    def columns(row: Row) -> list[float]:
        found: list[float] = []
        for key, count in sizes.items():
            values = numbers(row[key], count)
            if values is None:
                raise ValueError(key)
            found += values
        return found

    return columns


class _Message(NamedTuple):
    topic: str
    type_name: str
    names: tuple[str, ...]
    columns_of: _Columns


def _axes(pattern: str) -> tuple[str, ...]:
    return tuple(pattern.format(axis) for axis in "xyz")


_QUATERNION: Final = ("q0", "q1", "q2", "q3")
# Column by field of the message.
_MONITOR: Final = {
    "available_distance": "available_distance_km",
    "battery_level": "battery_level",
    "brake": "brake_bar",
    "brake_switch": "brake_switch",
    "gear_position": "gear_position",
    "left_signal": "left_signal",
    "rear_left_rpm": "rear_left_rpm",
    "rear_right_rpm": "rear_right_rpm",
    "right_signal": "right_signal",
    "steering": "steering_deg",
    "steering_speed": "steering_speed_degps",
    "throttle": "throttle",
    "vehicle_speed": "vehicle_speed_kmph",
    "yaw_rate": "yaw_rate_degps",
}
_SENSORS: Final = {
    "brake_sensor": "brake_sensor",
    "steering_sensor": "steering_sensor_deg",
    "throttle_sensor": "throttle_sensor",
}
MESSAGES: Final[dict[str, _Message]] = {
    "zoe_veh_info": _Message(
        "can/wheel_speed",
        "crosscue/WheelSpeeds",
        ("front_left_mps", "front_right_mps", "rear_left_mps", "rear_right_mps"),
        _plain(*(f"{w}_wheel_speed" for w in ("FL", "FR", "RL", "RR")), scale=RPM_TO_MPS),
    ),
    "steeranglefeedback": _Message(
        "can/steering", "crosscue/Table", ("steering_rad",), _plain("value", scale=-1.0)
    ),
    "ms_imu": _Message(
        "can/imu",
        "sensor_msgs/msg/Imu",
        (*_axes("accel_{}_mps2"), *_axes("gyro_{}_radps"), *_QUATERNION),
        _vectors(linear_accel=3, rotation_rate=3, q=4),
    ),
    "pose": _Message(
        "can/pose",
        "crosscue/Table",
        (*_axes("{}_m"), *_QUATERNION, *_axes("velocity_{}_mps"), *_axes("rotation_rate_{}_radps")),
        _vectors(pos=3, orientation=4, vel=3, rotation_rate=3),
    ),
    "vehicle_monitor": _Message(
        "can/vehicle_monitor", "crosscue/Table", tuple(_MONITOR.values()), _plain(*_MONITOR)
    ),
    "zoesensors": _Message(
        "can/zoesensors", "crosscue/Table", tuple(_SENSORS.values()), _plain(*_SENSORS)
    ),
}


def _held(file: Path, message: _Message) -> HeldRows | tuple[str, int | None, str]:
    """Return a message's rows in order of time, or the reason why they cannot be read."""
    rows = RowsOf(file)
    times: list[int] = []
    values: list[list[float]] = []
    bad, first = 0, ""
    for row in rows:
        try:
            found = message.columns_of(row)
            t_ns = int(row["utime"]) * 1000
            if not all(map(math.isfinite, found)):
                raise ValueError(message.topic)
        except (KeyError, TypeError, ValueError, OverflowError):
            bad += 1
            first = first or f"row {len(times) + bad}"
            continue
        times.append(t_ns)
        values.append(found)
    if not times:
        return DAMAGED_ROW, bad + rows.damaged or None, rows.first_damage or first
    losses = []
    if lost := bad + rows.damaged:
        losses.append(Loss(DAMAGED_ROW, lost, rows.first_damage or first))
    if rows.is_cut:
        losses.append(Loss(f"{file.name} is cut", None, "its array does not end"))
    order = np.argsort(np.array(times, np.int64), kind="stable")
    table = np.array(values, np.float64)[order]
    return HeldRows(
        Topic(message.topic, message.type_name, "columns", declared=len(times) + lost),
        np.array(times, np.int64)[order],
        Table({name: table[:, i] for i, name in enumerate(message.names)}),
        tuple(losses),
    )
