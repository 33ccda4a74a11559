"""Read a drive of the smartphone driving data set: a car's CAN values, and a phone's sensors.

A folder contains ``NAME_car.csv`` (speed, steering, engine and position at 10 Hz) and
``NAME_phone.csv`` (compass, gyro, gravity at 10 Hz, GNSS once a second). Both have stamps of wall
clocks without a time zone, which are read as UTC. A line of the phone's file is a row of several
topics, so a damaged line is dropped from each of them.
"""

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import Block, Floats, Int64s, Table, Topic
from crosscue.replay.errors import LogFormatError
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import MIB, Limits
from crosscue.replay.readers.held_rows import CameraDrive, HeldRows, Loss
from crosscue.replay.seal.touched import Touched

from .published import lines_of, note_whole

MAX_FILE_BYTES: Final = 256 * MIB
MILE_H_MPS: Final = 0.44704
MICROTESLA: Final = 1e-6
# Quarter of an hour; time zones differ from UTC by multiples of it.
QUARTER_HOUR_S: Final = 900.0
DAMAGED: Final = "a line that cannot be parsed"
GRAVITY: Final = tuple(f"motionGravity{axis}(G)" for axis in "XYZ")
GYRO: Final = tuple(f"gyroRotation{axis}(rad/s)" for axis in "XYZ")
FIELD: Final = tuple(f"locationHeading{axis}(µT)" for axis in "XYZ")
FIX_TIME: Final = "locationTimestamp_since1970(s)"
COURSE: Final = "locationCourse(°)"

Values = Mapping[str, Floats]


def _yaw_rate(of: Values) -> dict[str, Floats]:
    """Return the yaw rate about the vertical, from the phone's gravity vector (downwards)."""
    down = np.column_stack([of[name] for name in GRAVITY])
    rate = np.column_stack([of[name] for name in GYRO])
    return {"yaw_rate_radps": -(rate * down).sum(axis=1) / np.linalg.norm(down, axis=1)}


def _course(of: Values) -> dict[str, Floats]:
    course = np.deg2rad(90.0 - of[COURSE])
    return {"course_rad": np.arctan2(np.sin(course), np.cos(course))}


class _Stream(NamedTuple):
    """A topic: its type, and its columns.

    Attributes:
        type_name: Type of the topic.
        columns: Column of the file by our name.
        scale: Factor on these columns.
        more: Further columns that ``derived`` uses.
        derived: Function that computes columns.
    """

    type_name: str
    columns: Mapping[str, str]
    scale: float = 1.0
    more: tuple[str, ...] = ()
    derived: Callable[[Values], dict[str, Floats]] = lambda _: {}

    @property
    def fields(self) -> tuple[str, ...]:
        return (*self.more, *self.columns.values())


CAR: Final[dict[str, _Stream]] = {
    "car/speed": _Stream("crosscue/WheelSpeeds", {"speed_mps": "Speed (MPH)"}, MILE_H_MPS),
    "car/engine": _Stream(
        "crosscue/Table",
        {
            "steering_deg": "Steering Angle",
            "throttle_percent": "Throttle Position",
            "engine_rpm": "Engine RPM",
        },
    ),
    "car/position": _Stream(
        "crosscue/Table",
        {
            "latitude_deg": "Latitude / Y Position (Degrees)",
            "longitude_deg": "Longitude / X Position (Degrees)",
        },
    ),
}
PHONE: Final[dict[str, _Stream]] = {
    "phone/gyro": _Stream("sensor_msgs/msg/Imu", {}, more=(*GYRO, *GRAVITY), derived=_yaw_rate),
    "phone/magnetometer": _Stream(
        "sensor_msgs/msg/MagneticField",
        {f"mag_{axis}_t": name for axis, name in zip("xyz", FIELD, strict=True)},
        MICROTESLA,
    ),
}
FIX: Final = _Stream(
    "sensor_msgs/msg/NavSatFix",
    {
        "latitude_deg": "locationLatitude(WGS84)",
        "longitude_deg": "locationLongitude(WGS84)",
        "altitude_m": "locationAltitude(m)",
        "position_sd_m": "locationHorizontalAccuracy(m)",
        "speed_mps": "locationSpeed(m/s)",
    },
    more=(FIX_TIME, COURSE),
    derived=_course,
)


class PhoneDrive(CameraDrive):
    """One folder as a ``Log``."""

    format: Final = "phone-drive"

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Read all streams, in order of their first times; see ``Log.read``."""
        ledger.integrity = "not checkable: no checksums, and a missing line cannot be detected"
        yield from super().read(ledger, selection)


class _Lines(NamedTuple):
    t_ns: Int64s
    fields: list[dict[str, str]]
    losses: tuple[Loss, ...]


def open_phone_drive(path: Path, limits: Limits) -> PhoneDrive:
    """Read both files of a folder.

    Raises:
        LogFormatError: A file is missing, duplicated or too large, or lacks columns.
    """
    rows: list[HeldRows] = []
    touched = Touched()
    for kind, streams in (("car", CAR), ("phone", PHONE)):
        files = sorted(path.glob(f"*_{kind}.csv"))
        if len(files) != 1:
            names = ", ".join(file.name for file in files) or "none"
            raise LogFormatError(f"{path}: expected one file *_{kind}.csv, found {names}")
        wanted = {name for one in streams.values() for name in one.fields}
        wanted |= {*FIX.fields} if kind == "phone" else set()
        lines = _read(files[0], wanted)
        note_whole(touched, files[0])
        rows += [_held(name, one, lines) for name, one in streams.items()]
        if kind == "phone":
            rows.append(_fixes(lines))
    return PhoneDrive(path, (), rows, limits, touched)


def _read(file: Path, wanted: set[str]) -> _Lines:
    reader = csv.reader(lines_of(file, MAX_FILE_BYTES))
    header = next(reader, [])
    if missing := sorted(wanted - {*header}):
        names = ", ".join(map(repr, missing))
        raise LogFormatError(f"{file}: no column {names}; expected the published columns")
    times: list[int] = []
    fields: list[dict[str, str]] = []
    losses: list[Loss] = []
    for number, line in enumerate(reader, start=2):
        t_ns = _wall_ns(line[0]) if len(line) == len(header) else None
        if t_ns is None:
            losses.append(Loss(DAMAGED, 1, f"{file.name}:{number}: {','.join(line)[:60]!r}"))
            continue
        times.append(t_ns)
        fields.append(dict(zip(header, line, strict=True)))
    order = np.argsort(np.array(times, np.int64), kind="stable")
    return _Lines(
        np.array(times, np.int64)[order], [fields[i] for i in order.tolist()], tuple(losses)
    )


def _held(name: str, stream: _Stream, lines: _Lines) -> HeldRows:
    values = {one: _numbers(lines.fields, one) for one in stream.fields}
    good = np.isfinite(np.column_stack([*values.values()])).all(axis=1)
    bad = int((~good).sum())
    losses = lines.losses
    if bad:
        at = int(lines.t_ns[np.flatnonzero(~good)[0]])
        losses = (*losses, Loss("a field is not a number", bad, f"first at {at} ns"))
    t_ns = lines.t_ns[good]
    kept = {one: column[good] for one, column in values.items()}
    table = {ours: kept[theirs] * stream.scale for ours, theirs in stream.columns.items()}
    declared = len(t_ns) + sum(loss.rows or 0 for loss in losses)
    topic = Topic(name, stream.type_name, "columns", declared=declared)
    return HeldRows(topic, t_ns, Table({**table, **stream.derived(kept)}), losses)


def _fixes(lines: _Lines) -> HeldRows:
    fix_s = _numbers(lines.fields, FIX_TIME)
    is_new = np.isfinite(fix_s) & (np.diff(fix_s, prepend=-math.inf) > 0.0)
    rows = np.flatnonzero(is_new)
    behind_s = lines.t_ns[rows] * 1e-9 - fix_s[rows]
    zone_s = QUARTER_HOUR_S * round(float(np.median(behind_s)) / QUARTER_HOUR_S) if len(rows) else 0
    picked = _Lines(
        np.rint((fix_s[rows] + zone_s) * 1e9).astype(np.int64),
        [lines.fields[i] for i in rows.tolist()],
        # A damaged line may or may not have contained a new position.
        tuple(loss._replace(rows=None) for loss in lines.losses),
    )
    return _held("phone/gnss", FIX, picked)


def _wall_ns(text: str) -> int | None:
    """Parse a wall-clock time as UTC; None if it is not a time."""
    try:
        at = datetime.fromisoformat(text.strip()).replace(tzinfo=UTC)
    except ValueError:
        return None
    return round(at.timestamp() * 1e6) * 1000


def _numbers(lines: Sequence[Mapping[str, str]], name: str) -> Floats:
    return np.array([_number(line[name]) for line in lines], np.float64)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
