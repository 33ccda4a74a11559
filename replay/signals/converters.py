"""Convert decoded columns to samples in SI units: CAN signals by name, tables by their columns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from crosscue.replay.columns import Block, Floats, Int64s, Table
from crosscue.replay.errors import VehicleError
from crosscue.replay.ledger import Ledger

from .kinds import Samples, Signal

if TYPE_CHECKING:
    from crosscue.replay.vehicle.vehicle import AngleSignal

SPEED_UNITS: Final[Mapping[str, float]] = {
    "m/s": 1.0, "mps": 1.0, "km/h": 1 / 3.6, "kph": 1 / 3.6, "kmh": 1 / 3.6, "kmph": 1 / 3.6,
    "mph": 0.44704, "mi/h": 0.44704, "kph / km/h": 1 / 3.6, "unit_kilometerperhour": 1 / 3.6,
}  # fmt: skip
ANGLE_UNITS: Final[Mapping[str, float]] = {
    "rad": 1.0, "deg": np.pi / 180, "degree": np.pi / 180, "degrees": np.pi / 180,
    "°": np.pi / 180, "rad/s": 1.0, "deg/s": np.pi / 180, "degree/s": np.pi / 180,
    "degrees/s": np.pi / 180, "°/s": np.pi / 180, "deg/sec": np.pi / 180,
    "radians": 1.0, "radians/second": 1.0, "rad/sec": 1.0, "degrees/second": np.pi / 180,
    "unit_degreofarc": np.pi / 180, "unit_degreofarcpersecon": np.pi / 180,
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Column:
    t_ns: Int64s
    values: Floats


def column_of(
    tables: Mapping[str, Block],
    name: str | None,
    unit: str | None,
    scales: Mapping[str, float],
    key: str,
) -> _Column | None:
    """Return the column that the vehicle file names, in SI units; None if the block lacks it.

    Raises:
        VehicleError: Its unit is not in ``scales``.
    """
    if name is None:
        return None
    message, _, signal = name.partition(".")
    part = tables.get(message)
    if part is None or not isinstance(part.rows, Table) or signal not in part.rows.columns:
        return None
    found = unit or part.rows.units.get(signal, "")
    scale = scales.get(found.strip().lower())
    if scale is None:
        turning = found.strip().lower() == "rad/s"
        remedy = "wheel_radius_m" if turning else f"unit to one of {', '.join(sorted(scales))}"
        raise VehicleError(f"{key}: {name} has unit {found!r}; set {remedy} in that section")
    return _Column(part.log_ns, np.asarray(part.rows[signal], np.float64) * scale)


def wheel_samples(columns: Sequence[_Column | None]) -> Iterator[Samples]:
    """Yield the speeds of four wheels, front left to rear right, at times of the rear left one."""
    base = columns[2]
    if base is None or not len(base.t_ns):
        return
    speeds = np.full((len(base.t_ns), 4), np.nan)
    for i, column in enumerate(columns):
        if column is None or not len(column.t_ns):
            continue
        if column.t_ns is base.t_ns:
            speeds[:, i] = column.values
            continue
        # Wheels in other messages use their latest earlier reading.
        at = np.searchsorted(column.t_ns, base.t_ns, side="right") - 1
        speeds[:, i] = np.where(at >= 0, column.values[np.maximum(at, 0)], np.nan)
    yield Samples(Signal.WHEEL_SPEEDS, base.t_ns, speeds)


def angle_samples(
    tables: Mapping[str, Block], section: AngleSignal, signal: Signal, key: str
) -> Iterator[Samples]:
    """Yield samples of an angle or its rate, counter-clockwise."""
    column = column_of(tables, section.signal, section.unit, ANGLE_UNITS, key)
    if column is not None and len(column.t_ns):
        yield Samples(signal, column.t_ns, column.values * section.sign)


def _table(block: Block, ledger: Ledger, *names: str) -> Table | None:
    if isinstance(block.rows, Table) and all(name in block.rows.columns for name in names):
        return block.rows
    ledger.skip(block.topic, "lacks a column its role needs", len(block), ", ".join(names))
    return None


def _wheels(block: Block, ledger: Ledger) -> Iterator[Samples]:
    columns = block.rows.columns if isinstance(block.rows, Table) else {}
    for name in {"speed_x_mps", "speed_mps"} & set(columns):
        speed = np.asarray(columns[name], np.float64)
        nothing = np.full(len(block), np.nan)
        values = np.stack([nothing, nothing, speed, speed], axis=1)
        yield Samples(Signal.WHEEL_SPEEDS, block.log_ns, values)
        return
    names = ("front_left_mps", "front_right_mps", "rear_left_mps", "rear_right_mps")
    table = _table(block, ledger, *names)
    if table is not None:
        values = np.stack([np.asarray(table[name], np.float64) for name in names], axis=1)
        yield Samples(Signal.WHEEL_SPEEDS, block.log_ns, values)


def _one_of(signal: Signal, *names: str) -> Callable[[Block, Ledger], Iterator[Samples]]:
    def samples(block: Block, ledger: Ledger) -> Iterator[Samples]:
        for name in names:
            if isinstance(block.rows, Table) and name in block.rows.columns:
                values = np.asarray(block.rows[name], np.float64)
                yield Samples(signal, block.log_ns, values)
                return
        _table(block, ledger, *names)

    return samples


def _magnetic(block: Block, ledger: Ledger) -> Iterator[Samples]:
    names = ("mag_x_t", "mag_y_t", "mag_z_t")
    table = _table(block, ledger, *names)
    if table is not None:
        values = np.stack([np.asarray(table[name], np.float64) for name in names], axis=1)
        yield Samples(Signal.MAGNETIC_FIELD, block.log_ns, values)


def _heading(block: Block, ledger: Ledger) -> Iterator[Samples]:
    if isinstance(block.rows, Table) and "heading_rad" in block.rows.columns:
        yield Samples(Signal.HEADING, block.log_ns, np.asarray(block.rows["heading_rad"], float))
        return
    names = ("quat_x", "quat_y", "quat_z", "quat_w")
    table = _table(block, ledger, *names)
    if table is not None:
        x, y, z, w = (np.asarray(table[name], np.float64) for name in names)
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        yield Samples(Signal.HEADING, block.log_ns, yaw)


def _course(block: Block, ledger: Ledger) -> Iterator[Samples]:
    # A fix without course and speed is not a fault, because most receivers report neither.
    if isinstance(block.rows, Table) and {"course_rad", "speed_mps"} <= set(block.rows.columns):
        columns = [np.asarray(block.rows[name], float) for name in ("course_rad", "speed_mps")]
        yield Samples(Signal.COURSE, block.log_ns, np.stack(columns, axis=1))


def _position(block: Block, ledger: Ledger) -> Iterator[Samples]:
    names = ("latitude_deg", "longitude_deg", "altitude_m")
    table = block.rows
    if not (isinstance(table, Table) and {*names} <= set(table.columns)):
        return
    columns = [np.asarray(table[name], np.float64) for name in names]
    values = np.column_stack([*columns, _position_sd_m(table)])
    usable = np.isfinite(values[:, :2]).all(axis=1)
    if "status" in table.columns:
        usable &= np.asarray(table["status"]) >= 0
    ledger.skip(block.topic, "no position fix", int((~usable).sum()))
    yield Samples(Signal.POSITION, block.log_ns[usable], values[usable])


def _position_sd_m(table: Table) -> Floats:
    """Return the horizontal standard deviation; NaN where the receiver does not report it."""
    sd = np.full(len(table), np.nan)
    if "position_sd_m" in table.columns:
        sd = np.asarray(table["position_sd_m"], np.float64)
    elif "covariance_m2" in table.columns:
        cov = np.asarray(table["covariance_m2"], np.float64).reshape(len(table), -1)
        sd = np.sqrt(np.maximum(0.5 * (cov[:, 0] + cov[:, 4]), 0.0))
        if "covariance_type" in table.columns:
            sd = np.where(np.asarray(table["covariance_type"]) > 0, sd, np.nan)
    return np.where(sd > 0.0, sd, np.nan)


FROM_TABLE: Final[Mapping[Signal, Callable[[Block, Ledger], Iterator[Samples]]]] = {
    Signal.WHEEL_SPEEDS: _wheels,
    Signal.YAW_RATE: _one_of(Signal.YAW_RATE, "gyro_z_radps", "yaw_rate_radps"),
    Signal.STEERING: _one_of(Signal.STEERING, "steering_rad"),
    Signal.MAGNETIC_FIELD: _magnetic,
    Signal.HEADING: _heading,
    Signal.COURSE: _course,
    Signal.POSITION: _position,
}
