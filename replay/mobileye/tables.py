"""Tables of decoded frames and ROS messages, and their conversion between reference points.

Every table begins with ``t_ns`` (image time for obstacles and status, log time for the others) and
``burst`` (number of the last status frame, from 0; -1 before the first). Positions are in metres
from the rear axle, x ahead and y to the left; lanes are cubics y(x) in the same frame. ``layout``
is the variant of a row, as an index in ``layout.VARIANTS``; -1 if it is unknown.
``crosscue.replay.mobileye.layout.describe`` describes the other columns.
"""

from collections.abc import Mapping
from typing import Final, cast

import numpy as np

from crosscue.replay.columns import Block, Floats, Int64s, Table
from crosscue.replay.mobileye.geometry import DevicePosition

from .geometry import (
    device_T_vehicle,
    evaluate,
    move_cubic,
    move_points,
    turn_slope,
)
from .layout import Column, Columns, layout, unit_of

LEFT: Final = 1
RIGHT: Final = -1
# Lateral position sent for a side without a marking, half of a usual lane's width; such a side also
# has type 2, quality 0 and no range.
NO_LANE_C0_M: Final = 1.875
NO_LANE_TYPE: Final = 2

_CUBIC: Final = ("c0_m", "c1", "c2_per_m", "c3_per_m2")


def table_block(
    bus: str, name: str, log_ns: Int64s, columns: Columns, image_ns: Int64s | None = None
) -> Block:
    """Return the rows of one table as a block with topic ``BUS/mobileye/NAME``."""
    fields = (f for m in layout().values() if m.table == name for f in m.fields)
    units = {f.name: unit_of(f) for f in fields if unit_of(f)}
    return Block(f"{bus}/mobileye/{name}", log_ns, Table(columns, units), header_ns=image_ns)


def floats(column: Column) -> Floats:
    """Return a column as float64."""
    return cast("Floats", column)


def instance_of_lane(table: str, columns: Mapping[str, Column]) -> Int64s:
    """Return the instances of a lane message from the columns of ``lane_places``."""
    is_right: Int64s = (columns["side"] == RIGHT).astype(np.int64)
    if table != "next_lanes":
        return is_right
    index: Int64s = columns["index"].astype(np.int64)
    return 2 * index + is_right


def lane_places(table: str, instance: Int64s) -> Columns:
    """Return the columns that identify the lane of a row; ``index`` counts outwards from 0."""
    if table != "next_lanes":
        return {"side": np.where(instance == 0, LEFT, RIGHT).astype(np.int8)}
    side = np.where(instance % 2 == 0, LEFT, RIGHT).astype(np.int8)
    return {"side": side, "index": (instance // 2).astype(np.int8)}


def to_vehicle(table: str, columns: Columns, mounting: DevicePosition) -> Columns:
    """Convert columns from the device's reference point to the rear axle."""
    if table in ("lanes", "next_lanes"):
        return _lanes_to_vehicle(columns, mounting)
    return _moved(table, columns, mounting, mounting.x_m)


def to_device(table: str, columns: Columns, mounting: DevicePosition) -> Columns:
    """Convert columns from the rear axle to the device's reference point; some may be missing."""
    pose = device_T_vehicle(mounting)
    if table in ("lanes", "next_lanes"):
        return _lanes_to_device(columns, pose)
    return _moved(table, columns, pose, -mounting.x_m)


def _moved(table: str, columns: Columns, pose: DevicePosition, ahead_m: float) -> Columns:
    moved = dict(columns)

    def add(name: str, amount: float) -> None:
        if name in moved:
            moved[name] = floats(moved[name]) + amount

    if table == "obstacles":
        moved["x_m"], moved["y_m"] = move_points(
            pose, floats(columns["x_m"]), floats(columns["y_m"])
        )
        add("radar_x_m", ahead_m)
        add("angle_rad", pose.yaw_rad)
    elif table == "signs":
        add("x_m", ahead_m)
    elif table == "aftermarket_lane":
        add("y_left_m", pose.y_m)
        add("y_right_m", pose.y_m)
    elif table == "lane_details" and "c1" in columns and "c2_per_m" in columns:
        moved["c1"], moved["c2_per_m"] = turn_slope(
            pose.yaw_rad, floats(columns["c1"]), floats(columns["c2_per_m"])
        )
    return moved


def _cubic(columns: Columns) -> Floats:
    n = len(columns["c0_m"])
    absent = np.zeros(n)
    return np.vstack([floats(columns.get(name, absent)) for name in _CUBIC])


def _lanes_to_vehicle(columns: Columns, pose: DevicePosition) -> Columns:
    moved = dict(columns)
    on_device = _cubic(columns)
    range_m = floats(columns["view_range_m"])
    is_default = (columns["lane_type"] == NO_LANE_TYPE) & (columns["quality"] == 0)
    is_default &= (range_m == 0) & (
        on_device[0] == columns["side"].astype(np.float64) * NO_LANE_C0_M
    )
    is_default &= (on_device[2] == 0) & (on_device[3] == 0)
    in_vehicle = np.where(is_default, np.nan, move_cubic(pose, on_device))
    moved.update(zip(_CUBIC, in_vehicle, strict=True))
    moved["has_marking"] = ~is_default
    moved["x_start_m"] = move_points(pose, np.zeros(len(range_m)), on_device[0])[0]
    moved["x_end_m"] = move_points(pose, range_m, evaluate(on_device, range_m))[0]
    for name in ("x_start_m", "x_end_m"):
        moved[name] = np.where(is_default, np.nan, moved[name])
    return moved


def _lanes_to_device(columns: Columns, pose: DevicePosition) -> Columns:
    moved = dict(columns)
    in_vehicle = _cubic(columns)
    is_default = np.isnan(in_vehicle[0])
    on_device = move_cubic(pose, in_vehicle)
    on_device[:, is_default] = 0.0
    on_device[0, is_default] = columns["side"].astype(np.float64)[is_default] * NO_LANE_C0_M
    moved.update(zip(_CUBIC, on_device, strict=True))
    for name, value in (("lane_type", NO_LANE_TYPE), ("quality", 0), ("view_range_m", 0.0)):
        if name in columns:
            moved[name] = np.where(is_default, value, columns[name])
    return moved
