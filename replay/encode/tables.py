"""Encode tables as ROS 2 messages, of a standard type if its fields match the columns.

Any other table is encoded as ``crosscue_msgs/msg/<Topic>``: a header and one field for each numeric
column, with the column's name.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Block, Table
from crosscue.replay.decode.ros.plan import ParsingPlan
from crosscue.replay.decode.ros.standard import quat, xyz
from crosscue.replay.ledger import Ledger

from .outgoing import Outgoing, Ros2Type, own_type, stamps, standard_type, with_rows
from .template import filled, template_of

Columns = Mapping[str, NDArray[np.generic]]
# First element of a covariance without an estimate, as specified by sensor_msgs/msg/Imu.
ABSENT: Final = -1.0


@dataclass(frozen=True, slots=True)
class Standard:
    """A standard type that can hold a table.

    Attributes:
        type_name: Name of the type.
        needs: Sets of columns; a table must have all columns of at least one set.
        together: Sets of columns; a table must have all or none of each set.
        paths: Fields by column that the type can hold.
        rest: Function that derives further fields from the columns.
    """

    type_name: str
    needs: tuple[frozenset[str], ...]
    paths: Mapping[str, str]
    together: tuple[frozenset[str], ...] = ()
    rest: Callable[[Columns, int], Columns] | None = None

    def holds(self, columns: Columns) -> bool:
        """Return whether the type can hold all columns of a table."""
        names = frozenset(columns)
        if not names <= frozenset(self.paths) or not any(need <= names for need in self.needs):
            return False
        if any(group & names and not group <= names for group in self.together):
            return False
        return all(columns[name].dtype.kind in "fiub" for name in names)


_QUAT: Final = frozenset(f"quat_{axis}" for axis in "xyzw")
_XY: Final = frozenset({"x_m", "y_m"})


def _imu_rest(columns: Columns, size: int) -> Columns:
    """Mark the estimates that are missing by their covariances."""
    rest: dict[str, NDArray[np.generic]] = {}
    for name, field in (
        ("quat_w", "orientation"),
        ("gyro_x_radps", "angular_velocity"),
        ("accel_x_mps2", "linear_acceleration"),
    ):
        if name not in columns or np.isnan(columns[name].astype(np.float64)).all():
            covariance = np.zeros((size, 9))
            covariance[:, 0] = ABSENT
            rest[f"{field}_covariance"] = covariance
    return rest


_FIX: Final = {
    "latitude_deg": "latitude",
    "longitude_deg": "longitude",
    "altitude_m": "altitude",
    "status": "status.status",
    "covariance_m2": "position_covariance",
    "covariance_type": "position_covariance_type",
}


def _fix_rest(columns: Columns, size: int) -> Columns:
    return {} if "altitude_m" in columns else {"altitude": np.full(size, np.nan)}


_ACCEL: Final = frozenset(f"accel_{axis}_mps2" for axis in "xyz")
_GYRO: Final = frozenset(f"gyro_{axis}_radps" for axis in "xyz")

STANDARDS: Final = (
    Standard(
        "sensor_msgs/msg/Imu",
        (_ACCEL, _GYRO),
        xyz("accel_{}_mps2", "linear_acceleration")
        | xyz("gyro_{}_radps", "angular_velocity")
        | quat("orientation"),
        (_ACCEL, _GYRO, _QUAT),
        _imu_rest,
    ),
    Standard(
        "sensor_msgs/msg/MagneticField",
        (frozenset(f"mag_{axis}_t" for axis in "xyz"),),
        xyz("mag_{}_t", "magnetic_field"),
    ),
    Standard(
        "sensor_msgs/msg/NavSatFix",
        (frozenset({"latitude_deg", "longitude_deg"}),),
        _FIX,
        rest=_fix_rest,
    ),
    Standard(
        "geometry_msgs/msg/PoseStamped",
        (_XY | _QUAT,),
        xyz("{}_m", "pose.position") | quat("pose.orientation"),
    ),
    Standard(
        "nav_msgs/msg/Odometry",
        (_XY | _QUAT | {"speed_x_mps"}, _XY | _QUAT | {"yaw_rate_radps"}),
        xyz("{}_m", "pose.pose.position")
        | quat("pose.pose.orientation")
        | {
            "speed_x_mps": "twist.twist.linear.x",
            "speed_y_mps": "twist.twist.linear.y",
            "yaw_rate_radps": "twist.twist.angular.z",
        },
    ),
)


def table_messages(block: Block, table: Table, types: OwnTypes, ledger: Ledger) -> list[Outgoing]:
    """Return rows of a table as messages."""
    standard = next((each for each in STANDARDS if each.holds(table.columns)), None)
    if standard is not None and types.fields_of(block.topic) is None:
        return [_as_standard(block, table, standard)]
    return [types.messages(block, table, ledger)]


def _as_standard(block: Block, table: Table, standard: Standard) -> Outgoing:
    kind, plan = standard_type(standard.type_name)
    size = len(block)
    values = {standard.paths[name]: column for name, column in table.columns.items()}
    if standard.rest is not None:
        values = dict(standard.rest(table.columns, size)) | values
    frame = template_of(plan, {"header.frame_id": block.topic.lstrip("/")})
    rows = filled(plan, frame, size, {"header.stamp": stamps(block), **values})
    return Outgoing(kind, with_rows(block, rows))


@dataclass(frozen=True, slots=True)
class _Own:
    """A type created for one topic.

    Attributes:
        type: The type.
        plan: Plan of its CDR form.
        fields: Field, shape (without rows) and NumPy code by column.
    """

    type: Ros2Type
    plan: ParsingPlan
    fields: Mapping[str, tuple[str, tuple[int, ...], str]]


_CODES: Final = {
    "b1": "bool", "i1": "int8", "u1": "uint8", "i2": "int16", "u2": "uint16", "i4": "int32",
    "u4": "uint32", "i8": "int64", "u8": "uint64", "f4": "float32", "f8": "float64",
}  # fmt: skip


class OwnTypes:
    """Types created so far; a topic keeps the type of its first block."""

    def __init__(self) -> None:
        """Begin without types."""
        self._made: dict[str, _Own] = {}
        self._names: set[str] = set()

    def fields_of(self, topic: str) -> Mapping[str, tuple[str, tuple[int, ...], str]] | None:
        """Return the fields of the type created for ``topic``, or None."""
        own = self._made.get(topic)
        return None if own is None else own.fields

    def messages(self, block: Block, table: Table, ledger: Ledger) -> Outgoing:
        """Return rows as messages of the topic's own type, and report what it cannot hold."""
        own = self._made.get(block.topic)
        if own is None:
            own = self._made[block.topic] = self._make(block.topic, table)
        left_out = [name for name in table.columns if name not in own.fields]
        if left_out:
            ledger.notice(
                f"{block.topic}: columns not numeric, or absent at first, are not written: "
                f"{', '.join(left_out[:8])}"
            )
        values: dict[str, NDArray[np.generic]] = {"header.stamp": stamps(block)}
        for name, (field, shape, code) in own.fields.items():
            column = table.columns.get(name)
            if column is None or column.shape[1:] != shape:
                filler = np.nan if code in ("f4", "f8") else 0
                column = np.full((len(block), *shape), filler, code)
                ledger.notice(f"{block.topic}: rows without {name} are written with {filler}")
            values[field] = column
        frame = template_of(own.plan, {"header.frame_id": block.topic.lstrip("/")})
        return Outgoing(own.type, with_rows(block, filled(own.plan, frame, len(block), values)))

    def _make(self, topic: str, table: Table) -> _Own:
        fields: dict[str, tuple[str, tuple[int, ...], str]] = {}
        lines = ["std_msgs/Header header"]
        used = {"header"}
        for name, column in table.columns.items():
            code = f"{column.dtype.kind}{column.dtype.itemsize}"
            if code not in _CODES or column.ndim > 2 or 0 in column.shape[1:]:
                continue
            field = _unused(_field_name(name), used)
            array = f"[{column.shape[1]}]" if column.ndim == 2 else ""
            lines.append(f"{_CODES[code]}{array} {field}")
            fields[name] = (field, column.shape[1:], code)
        type_name = _unused(_type_name(topic), self._names)
        kind, plan = own_type(f"crosscue_msgs/msg/{type_name}", "\n".join(lines) + "\n")
        return _Own(kind, plan, fields)


def _field_name(column: str) -> str:
    """Return a ROS 2 field name: lower case, digits and single underscores, a letter first."""
    name = re.sub(r"_+", "_", re.sub(r"[^a-z0-9]", "_", column.lower())).strip("_")
    return name if name and name[0].isalpha() else f"c_{name}".strip("_")


def _type_name(topic: str) -> str:
    words = re.findall(r"[A-Za-z0-9]+", topic)
    name = "".join(word[0].upper() + word[1:] for word in words) or "Table"
    return name if name[0].isalpha() else f"T{name}"


def _unused(name: str, used: set[str]) -> str:
    chosen, k = name, 2
    while chosen in used:
        chosen, k = f"{name}{k}", k + 1
    used.add(chosen)
    return chosen
