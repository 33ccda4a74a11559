"""Table of the ROS message types with standard columns, one line per type.

All other types become tables of all their numbers with dotted names (``pose.position.x``), and with
``<name>.length`` for every sequence.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import (
    DATA,
    ERROR,
    REMOTE,
    CanFrames,
    ImageCoding,
    Images,
    Int64s,
    Messages,
    Table,
)
from crosscue.replay.decode.coding import JPEG, MAGIC_BYTES, MAX_SIDE_PX, STREAMS, coding_of
from crosscue.replay.decode.refuse import (
    BIG_ENDIAN,
    EMPTY_PICTURE,
    IMAGE_CODING,
    LONG_LENS,
    VIDEO_CODING,
)
from crosscue.replay.decode.ros.fields import FieldColumns
from crosscue.replay.decode.ros.plan import ParsingPlan
from crosscue.replay.decode.ros.walk import Bools, gather
from crosscue.replay.errors import SchemaError


def xyz(columns: str, path: str) -> dict[str, str]:
    """Map columns to the fields of a vector's components; ``columns`` has {} for the axis."""
    return {columns.format(axis): f"{path}.{axis}" for axis in "xyz"}


def quat(path: str) -> dict[str, str]:
    """Map columns to the fields of a quaternion's components."""
    return {f"quat_{axis}": f"{path}.{axis}" for axis in "xyzw"}


Decoded: TypeAlias = CanFrames | Table | Images
# Messages that fit their definition but cannot be used, and the reason for the ledger.
Doubt: TypeAlias = tuple[Bools, str]

FD_BYTES: Final = 64
# OpenCV's largest distortion model.
LENS_COEFFICIENTS: Final = 14


@dataclass(frozen=True, slots=True)
class RosConversion:
    """Conversion of one message type to rows.

    Attributes:
        needs: Fields that the definition must have: ``path`` for a number, ``path:9`` for an array
            of nine, ``path$`` for a string, ``path[u1]`` for a sequence of that NumPy code; ``|``
            means or.
        build: Function from the fields of usable messages to rows.
        doubts: Function that yields the messages that are not usable, and the reason.
    """

    needs: tuple[str, ...]
    build: Callable[[FieldColumns], Decoded]
    doubts: Callable[[FieldColumns], Iterator[Doubt]] | None = None

    def check(self, plan: ParsingPlan) -> None:
        """Check that a definition has the fields of its type.

        Raises:
            SchemaError: A field is missing; the message names it.
        """
        known = {f"{path}:{value.count}" for path, value in plan.values.items()}
        known |= {f"{path}$" for path in plan.texts}
        known |= {f"{path}[{items.code}]" for path, items in plan.sequences.items()}
        for need in self.needs:
            choices = [
                each if each[-1] in "$]" or ":" in each else f"{each}:0" for each in need.split("|")
            ]
            if not known.intersection(choices):
                raise SchemaError(
                    f"{plan.type_name}: its definition lacks the field {need}; "
                    "the log's definition and the type's name do not agree"
                )


def _table(**sources: str) -> RosConversion:
    """Return the kind of a table with one field per column; ``path:9`` is an array of nine."""

    def build(fields: FieldColumns) -> Table:
        return Table({name: fields.number(path.split(":")[0]) for name, path in sources.items()})

    return RosConversion(tuple(sources.values()), build)


# Mask of the bytes that a frame carries, by its length.
_CARRIED: Final = np.where(np.arange(8) < np.arange(9)[:, None], 255, 0).astype(np.uint8)


def _can_frame(fields: FieldColumns) -> CanFrames:
    length = fields.number("dlc").astype(np.uint8, copy=False)
    payload = fields.number("data").astype(np.uint8, copy=False)
    kind = _frame_kinds(fields)
    if np.count_nonzero(kind):
        length = np.where(kind == REMOTE, np.uint8(0), length)
    if np.count_nonzero(length != payload.shape[1]):
        payload = payload & _CARRIED[length]
    return CanFrames(
        fields.number("id").astype(np.uint32, copy=False),
        fields.number("is_extended").astype(np.bool_, copy=False),
        kind,
        length,
        payload,
        np.zeros(len(fields), np.bool_),
    )


def _frame_kinds(fields: FieldColumns) -> NDArray[np.uint8]:
    remote = fields.number("is_rtr").astype(np.bool_, copy=False)
    error = fields.number("is_error").astype(np.bool_, copy=False)
    if not np.count_nonzero(remote) and not np.count_nonzero(error):
        return np.full(len(fields), DATA, np.uint8)
    return np.where(error, ERROR, np.where(remote, REMOTE, DATA)).astype(np.uint8)


def _can_doubts(fields: FieldColumns) -> Iterator[Doubt]:
    identifier = _unsigned(fields.number("id"))
    long = identifier > 0x7FF
    if np.count_nonzero(long):
        extended = fields.number("is_extended").astype(np.bool_, copy=False)
        error = fields.number("is_error").astype(np.bool_, copy=False)
        too_long = long & ~(extended | error) | (identifier > 0x1FFF_FFFF)
        yield too_long, "identifier has more bits than its frame kind"
    yield _unsigned(fields.number("dlc")) > 8, "data length code over 8"


def _unsigned(column: NDArray[np.generic]) -> NDArray[np.unsignedinteger]:
    """Return numbers as unsigned: negative ones of a wrong definition are too large as well."""
    if np.issubdtype(column.dtype, np.unsignedinteger):
        return column.view(column.dtype)
    return column.astype(np.int64).view(np.uint64)


def _can_fd_frame(fields: FieldColumns) -> CanFrames:
    first, length = fields.items("data")
    payload = np.zeros((len(fields), FD_BYTES), np.uint8)
    for k in range(int(length.max(initial=0))):
        has = length > k
        payload[has, k] = fields.buffer[first[has] + k]
    return CanFrames(
        fields.number("id").astype(np.uint32),
        fields.number("is_extended").astype(np.bool_),
        _frame_kinds(fields),
        length.astype(np.uint8),
        payload,
        fields.number("is_fd").astype(np.bool_),
    )


def _can_fd_doubts(fields: FieldColumns) -> Iterator[Doubt]:
    identifier = fields.number("id").astype(np.int64)
    extended = fields.number("is_extended").astype(np.bool_)
    max_id = np.where(extended, 0x1FFF_FFFF, 0x7FF)
    yield identifier > max_id, "identifier has more bits than its frame kind"
    yield fields.items("data")[1] > FD_BYTES, "over 64 data bytes"


def _picture_ranges(fields: FieldColumns) -> Messages:
    first, size = fields.items("data")
    return Messages(fields.buffer, first, first + size)


def _codings(fields: FieldColumns) -> Sequence[ImageCoding | None]:
    first, size = fields.items("data")
    if len(fields) and np.minimum.reduce(size) >= len(JPEG):
        begins = gather(fields.buffer, "<u2", 0, first)
        if not np.count_nonzero(begins != int.from_bytes(JPEG, "little")):
            jpeg: ImageCoding = "jpeg"
            return (jpeg,) * len(fields)
    pictures = _picture_ranges(fields)
    return [
        coding_of(pictures.payload(i)[:MAGIC_BYTES].tobytes(), label)
        for i, label in enumerate(fields.texts("format"))
    ]


def _compressed(fields: FieldColumns) -> Images:
    return Images(_picture_ranges(fields), tuple(c for c in _codings(fields) if c is not None))


def _compressed_doubts(fields: FieldColumns) -> Iterator[Doubt]:
    yield fields.items("data")[1] == 0, EMPTY_PICTURE
    codings = _codings(fields)
    if None in codings:
        yield np.array([c is None for c in codings], np.bool_), IMAGE_CODING


def _video(fields: FieldColumns) -> Images:
    labels = fields.texts("format")
    return Images(_picture_ranges(fields), tuple(STREAMS[label.lower()] for label in labels))


def _video_doubts(fields: FieldColumns) -> Iterator[Doubt]:
    yield fields.items("data")[1] == 0, EMPTY_PICTURE
    known = [label.lower() in STREAMS for label in fields.texts("format")]
    yield ~np.array(known, np.bool_), VIDEO_CODING


def _raw(fields: FieldColumns) -> Images:
    return Images(
        _picture_ranges(fields),
        ("raw",) * len(fields),
        width_px=fields.number("width").astype(np.int32),
        height_px=fields.number("height").astype(np.int32),
        step_bytes=fields.number("step").astype(np.int32),
        pixel_format=fields.texts("encoding"),
    )


def _raw_doubts(fields: FieldColumns) -> Iterator[Doubt]:
    width, height, step = (
        fields.number(name).astype(np.int64) for name in ("width", "height", "step")
    )
    size = fields.items("data")[1]
    yield size == 0, EMPTY_PICTURE
    small, large = np.minimum(width, height), np.maximum(width, height)
    yield (small < 1) | (large > MAX_SIDE_PX), "implausible picture size"
    yield (step < width) | (size < step * height), "picture has fewer bytes than its size needs"
    big = fields.number("is_bigendian").astype(np.bool_)
    deep = np.array(["16" in each or "32" in each for each in fields.texts("encoding")], np.bool_)
    yield big & deep, BIG_ENDIAN


def _camera_info(fields: FieldColumns) -> Table:
    names = fields.plan.values
    lens = "d" if "d" in fields.plan.sequences else "D"
    columns: dict[str, NDArray[np.generic]] = {
        "width_px": fields.number("width"),
        "height_px": fields.number("height"),
        "k": fields.number("k" if "k" in names else "K"),
        "p": fields.number("p" if "p" in names else "P"),
        "d": fields.padded(lens, LENS_COEFFICIENTS),
    }
    return Table(columns)


def _camera_info_doubts(fields: FieldColumns) -> Iterator[Doubt]:
    lens = "d" if "d" in fields.plan.sequences else "D"
    yield fields.items(lens)[1] > LENS_COEFFICIENTS, LONG_LENS


_IMU: Final = {
    "linear_acceleration": xyz("accel_{}_mps2", "linear_acceleration"),
    "angular_velocity": xyz("gyro_{}_radps", "angular_velocity"),
    "orientation": quat("orientation"),
}


def _imu(fields: FieldColumns) -> Table:
    """Build the table; values are NaN where a covariance of -1 marks a missing estimate."""
    columns: dict[str, NDArray[np.generic]] = {}
    for estimate, sources in _IMU.items():
        covariance = fields.number(f"{estimate}_covariance").astype(np.float64, copy=False)
        absent = covariance[:, 0] == -1.0
        for name, path in sources.items():
            column = fields.number(path)
            columns[name] = np.where(absent, np.nan, column) if absent.any() else column
    return Table(columns)


_POSE: Final = xyz("{}_m", "pose.position") | quat("pose.orientation")
_POSE_COV: Final = xyz("{}_m", "pose.pose.position") | quat("pose.pose.orientation")

BY_TYPE: Final[Mapping[str, RosConversion]] = {
    "can_msgs/msg/Frame": RosConversion(
        ("id", "is_rtr", "is_extended", "is_error", "dlc", "data:8"), _can_frame, _can_doubts
    ),
    "crosscue_msgs/msg/CanFdFrame": RosConversion(
        ("id", "is_rtr", "is_extended", "is_error", "is_fd", "data[u1]"),
        _can_fd_frame,
        _can_fd_doubts,
    ),
    "sensor_msgs/msg/CompressedImage": RosConversion(
        ("format$", "data[u1]"), _compressed, _compressed_doubts
    ),
    "foxglove_msgs/msg/CompressedImage": RosConversion(
        ("format$", "data[u1]"), _compressed, _compressed_doubts
    ),
    "foxglove_msgs/msg/CompressedVideo": RosConversion(
        ("format$", "data[u1]"), _video, _video_doubts
    ),
    "sensor_msgs/msg/Image": RosConversion(
        ("width", "height", "step", "encoding$", "is_bigendian", "data[u1]"), _raw, _raw_doubts
    ),
    "sensor_msgs/msg/CameraInfo": RosConversion(
        ("width", "height", "k:9|K:9", "p:12|P:12", "d[f8]|D[f8]"),
        _camera_info,
        _camera_info_doubts,
    ),
    "sensor_msgs/msg/Imu": RosConversion(
        tuple(path for columns in _IMU.values() for path in columns.values())
        + tuple(f"{estimate}_covariance:9" for estimate in _IMU),
        _imu,
    ),
    "sensor_msgs/msg/MagneticField": _table(**xyz("mag_{}_t", "magnetic_field")),
    "sensor_msgs/msg/NavSatFix": _table(
        latitude_deg="latitude",
        longitude_deg="longitude",
        altitude_m="altitude",
        status="status.status",
        covariance_m2="position_covariance:9",
        covariance_type="position_covariance_type",
    ),
    "nav_msgs/msg/Odometry": _table(
        **_POSE_COV,
        speed_x_mps="twist.twist.linear.x",
        speed_y_mps="twist.twist.linear.y",
        yaw_rate_radps="twist.twist.angular.z",
    ),
    "geometry_msgs/msg/PoseStamped": _table(**_POSE),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _table(**_POSE_COV),
}


def generic(fields: FieldColumns) -> Table:
    """Return all numbers of messages with dotted names, and the length of every sequence."""
    columns: dict[str, NDArray[np.generic]] = {
        path: fields.number(path) for path in fields.plan.values
    }
    for path, items in fields.plan.sequences.items():
        if items.count is None:
            columns[f"{path}.length"] = fields.items(path)[1]
    if not columns:
        columns["present"] = np.ones(len(fields), np.bool_)
    return Table(columns)


# Prefix of the types that ``crosscue convert`` creates for tables, with columns as fields.
OWN_TYPES: Final = "crosscue_msgs/msg/"


def own_table(fields: FieldColumns) -> Table:
    """Return the table that a type of ``crosscue convert`` stores."""
    columns = dict(generic(fields).columns)
    columns.pop("header.stamp", None)
    return Table(columns or {"present": np.ones(len(fields), np.bool_)})


def conversion_for(type_name: str) -> RosConversion:
    """Return the conversion of a type."""
    if type_name in BY_TYPE:
        return BY_TYPE[type_name]
    return RosConversion((), own_table if type_name.startswith(OWN_TYPES) else generic)


# Paths of the sensor's time in a message; the first one found is used.
STAMPS: Final = ("header.stamp", "timestamp", "stamp")


def header_ns(fields: FieldColumns) -> Int64s | None:
    """Return the sensor's own time, shape (M,), or None for a type without one."""
    values = fields.plan.values
    for path in STAMPS:
        if path in values and values[path].code == "time":
            return fields.number(path).astype(np.int64, copy=False)
    return None
