"""comma2k19: one-minute segments of a Toyota RAV4 or Honda Civic with raw CAN, IMU, GNSS and pose.

Every stream is a pair of arrays, times (seconds of the device's boot clock) and values; all share
one clock. The data set's axes [forward, right, down] are converted to REP-103's [forward, left, up]
on reading. CAN payloads are stored padded to 8 bytes, without their true lengths.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import (
    DATA,
    LENGTH_UNKNOWN,
    Block,
    CanFrames,
    Int64s,
    Rows,
    Table,
    Topic,
)
from crosscue.replay.errors import LogFormatError
from crosscue.replay.files.closing import Closing
from crosscue.replay.ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC, Ledger
from crosscue.replay.limits import Limits


@dataclass(frozen=True, slots=True, eq=False)
class ArrayColumn:
    """The readable rows of one array file.

    Attributes:
        path: Path of the file.
        rows: Complete rows, shape (N, ...); mapped from the file if its layout allows.
        declared: Number of rows declared in the header.
    """

    path: Path
    rows: NDArray[np.generic]
    declared: int

    @property
    def missing(self) -> int:
        """Number of missing rows."""
        return self.declared - len(self.rows)


def read_column(path: Path) -> ArrayColumn:
    """Map an array file, or the complete rows of a truncated file.

    Raises:
        LogFormatError: The file is not an .npy file, or contains Python objects.
    """
    try:
        with path.open("rb") as file:
            version = npy_format.read_magic(file)
            if version == (1, 0):
                shape, by_columns, dtype = npy_format.read_array_header_1_0(file)
            elif version == (2, 0):
                shape, by_columns, dtype = npy_format.read_array_header_2_0(file)
            else:
                raise ValueError(f"version {version}")
            offset = file.tell()
    except (ValueError, UnicodeDecodeError, SyntaxError, TypeError, EOFError) as error:
        raise LogFormatError(f"{path}: not a NumPy array file ({error}); copy it again") from None
    if dtype.hasobject or not shape or dtype.itemsize == 0 or any(side < 0 for side in shape):
        raise LogFormatError(f"{path}: expected an array of plain numbers, got {dtype} {shape}")
    width = int(np.prod(shape[1:], dtype=np.int64))
    cells = max(0, path.stat().st_size - offset) // dtype.itemsize
    present = min(shape[0], cells // width if width else 0)
    if by_columns and len(shape) > 1:
        # In column-major order, a row is complete only if the last column contains it.
        present = max(0, min(shape[0], cells - (width - 1) * shape[0]))
    if present == 0:
        return ArrayColumn(path, np.empty((0, *shape[1:]), dtype), shape[0])
    if by_columns and len(shape) > 1:
        flat = np.memmap(path, dtype, "r", offset, ((width - 1) * shape[0] + present,))
        by_column = [flat[i * shape[0] : i * shape[0] + present] for i in range(width)]
        return ArrayColumn(path, np.stack(by_column, axis=1).reshape(present, *shape[1:]), shape[0])
    mapped = np.memmap(path, dtype, "r", offset, (present, *shape[1:]))
    return ArrayColumn(path, mapped, shape[0])


CUT, UNREADABLE = "array file is cut", "array cannot be read"
STEP_NS: Final = 1_000_000_000
LATEST_NS: Final = 1 << 62
NO_TIME: Final = -(1 << 63)
MICROTESLA: Final = 1e-6
# Signs that convert [forward, right, down] to [forward, left, up].
FLIP: Final = np.array([1.0, -1.0, -1.0])

Values = NDArray[np.generic]


def _imu_axes(prefix: str, unit: str, scale: float = 1.0) -> Callable[[Values], Table]:
    def table(values: Values) -> Table:
        xyz = np.asarray(values[:, :3], np.float64) * (FLIP * scale)
        return Table({f"{prefix}_{axis}_{unit}": xyz[:, i] for i, axis in enumerate("xyz")})

    return table


def _named(*names: str) -> Callable[[Values], Table]:
    def table(values: Values) -> Table:
        wide = np.asarray(values, np.float64).reshape(len(values), -1)
        return Table({name: wide[:, i] for i, name in enumerate(names)})

    return table


def _fix(values: Values) -> Table:
    wide = np.asarray(values, np.float64)
    course = np.deg2rad(90.0 - wide[:, 5])
    return Table(
        {
            "latitude_deg": wide[:, 0],
            "longitude_deg": wide[:, 1],
            "altitude_m": wide[:, 4],
            "speed_mps": wide[:, 2],
            "course_rad": np.arctan2(np.sin(course), np.cos(course)),
            "utc_ms": wide[:, 3],
        }
    )


@dataclass(frozen=True, slots=True)
class _Stream:
    type_name: str
    folder: str
    to_table: Callable[[Values], Table]
    width: int
    """Number of columns."""


_RAW_GNSS = _named(
    "satellite", "gps_week", "gps_tow_s", "glonass_channel", "pseudorange_m", "pseudorange_sd_m",
    "pseudorange_rate_mps", "pseudorange_rate_sd_mps",
)  # fmt: skip

STREAMS: Final[dict[str, _Stream]] = {
    "imu/gyro": _Stream("sensor_msgs/msg/Imu", "IMU/gyro", _imu_axes("gyro", "radps"), 3),
    "imu/accelerometer": _Stream(
        "crosscue/Table", "IMU/accelerometer", _imu_axes("accel", "mps2"), 3
    ),
    "imu/gyro_bias": _Stream("crosscue/Table", "IMU/gyro_bias", _imu_axes("gyro_bias", "radps"), 3),
    "imu/gyro_uncalibrated": _Stream(
        "crosscue/Table", "IMU/gyro_uncalibrated", _imu_axes("gyro", "radps"), 3
    ),
    "imu/magnetometer": _Stream(
        "sensor_msgs/msg/MagneticField", "IMU/magnetometer", _imu_axes("mag", "t", MICROTESLA), 3
    ),
    "imu/magnetometer_uncalibrated": _Stream(
        "crosscue/Table", "IMU/magnetometer_uncalibrated", _imu_axes("mag", "t", MICROTESLA), 3
    ),
    "gnss/ublox": _Stream("sensor_msgs/msg/NavSatFix", "GNSS/live_gnss_ublox", _fix, 6),
    "gnss/qcom": _Stream("crosscue/Table", "GNSS/live_gnss_qcom", _fix, 6),
    "gnss/raw_ublox": _Stream("crosscue/Table", "GNSS/raw_gnss_ublox", _RAW_GNSS, 8),
    "gnss/raw_qcom": _Stream("crosscue/Table", "GNSS/raw_gnss_qcom", _RAW_GNSS, 8),
    "car/wheel_speed": _Stream(
        "crosscue/WheelSpeeds", "CAN/wheel_speed",
        _named("front_left_mps", "front_right_mps", "rear_left_mps", "rear_right_mps"), 4,
    ),
    "car/speed": _Stream("crosscue/Table", "CAN/speed", _named("speed_mps"), 1),
    "car/steering_angle": _Stream(
        "crosscue/Table", "CAN/steering_angle", _named("steering_deg"), 1
    ),
    "car/radar": _Stream(
        "crosscue/Table", "CAN/radar",
        _named("x_m", "right_m", "relative_speed_mps", "unused_a", "unused_b", "address", "new"), 7,
    ),
}  # fmt: skip


@dataclass(slots=True, eq=False)
class _Source:
    topic: Topic
    t_ns: Int64s
    rows: Callable[[slice], Rows]
    files: tuple[ArrayColumn, ...]
    reach_ns: Int64s = field(init=False)

    def __post_init__(self) -> None:
        self.reach_ns = np.maximum.accumulate(self.t_ns) if len(self.t_ns) else self.t_ns


class CommaSegment(Closing):
    """One segment folder as a ``Log``."""

    format: Final = "comma2k19"

    def __init__(self, path: Path) -> None:
        """Map all arrays of the segment.

        Raises:
            LogFormatError: The folder contains no readable stream.
        """
        self.path: Final = path
        self._unreadable: list[str] = []
        self._sources = [*self._can_sources(), *self._streams()]
        if not self._sources:
            why = self._unreadable[0] if self._unreadable else "no arrays in processed_log"
            raise LogFormatError(f"{path}: no stream of a comma2k19 segment can be read: {why}")

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Streams of the segment, with one topic per CAN bus."""
        return tuple(source.topic for source in self._sources)

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Read all streams in parallel, a second at a time; see ``Log.read``."""
        ledger.integrity = "not checkable: .npy files have no checksum; lengths were compared"
        for sentence in self._unreadable:
            ledger.drop("", UNREADABLE, None, sentence)
        for source in self._sources:
            ledger.declare(source.topic.name, source.topic.declared)
        if any(source.topic.type_name == "crosscue/CanFrames" for source in self._sources):
            ledger.notice("comma2k19 does not store CAN frame lengths; payloads are zero-padded")
        filled = [source for source in self._sources if len(source.t_ns)]
        if filled:
            cursors = [0] * len(filled)
            while waiting := [
                int(s.reach_ns[at])
                for at, s in zip(cursors, filled, strict=True)
                if at < len(s.t_ns)
            ]:
                # Start at the earliest row, because damaged times may be years apart.
                edge_ns = min(waiting) + STEP_NS
                for i, source in enumerate(filled):
                    stop = int(np.searchsorted(source.reach_ns, edge_ns))
                    if stop > cursors[i]:
                        yield from _block(source, slice(cursors[i], stop), ledger, selection)
                        cursors[i] = stop
        for source in self._sources:
            for column in source.files:
                if column.missing:
                    ledger.notice(
                        f"{column.path.relative_to(self.path)}: cut: {len(column.rows)} of "
                        f"{column.declared} rows are there"
                    )
            ledger.settle(source.topic.name, CUT)

    def report_missing(self, ledger: Ledger) -> None:
        """Report arrays that are truncated or cannot be read; see ``KnowsItsEnd``."""
        for sentence in self._unreadable:
            ledger.drop("", UNREADABLE, None, sentence)
        for source in self._sources:
            missing = (source.topic.declared or 0) - len(source.t_ns)
            ledger.drop(source.topic.name, CUT, missing)

    def close(self) -> None:
        """Release the mapped files."""
        self._sources = []

    def _column(self, relative: str) -> ArrayColumn | None:
        path = self.path / "processed_log" / relative
        if not path.is_file():
            return None
        try:
            return read_column(path)
        except LogFormatError as error:
            self._unreadable.append(str(error))
            return None

    def _has(self, column: ArrayColumn, kinds: str, width: int = 0) -> bool:
        """Check that rows are numbers of these kinds with ``width`` columns; 0 for scalars."""
        rows, sides = column.rows, column.rows.shape[1:]
        has_columns = len(sides) == 1 and sides[0] >= width > 0
        if rows.dtype.kind in kinds and (has_columns or (not sides and width < 2)):
            return True
        self._unreadable.append(
            f"{column.path}: expected numbers in {max(width, 1)} columns, found {rows.dtype} in "
            f"{'x'.join(map(str, sides or (1,)))}; copy it again"
        )
        return False

    def _streams(self) -> Iterator[_Source]:
        for name, stream in STREAMS.items():
            times = self._column(f"{stream.folder}/t")
            values = self._column(f"{stream.folder}/value")
            if times is None or values is None:
                continue
            if not (self._has(times, "iuf") and self._has(values, "iuf", stream.width)):
                continue
            n = min(len(times.rows), len(values.rows))
            declared = max(times.declared, values.declared)
            topic = Topic(name, stream.type_name, "columns", declared=declared)
            rows, to_table = values.rows, stream.to_table
            yield _Source(
                topic,
                _to_ns(times.rows[:n]),
                lambda part, rows=rows, to_table=to_table: to_table(np.asarray(rows[part])),  # type: ignore[misc]
                (times, values),
            )

    def _can_sources(self) -> Iterator[_Source]:
        columns = [self._column(f"CAN/raw_can/{name}") for name in ("t", "src", "address", "data")]
        times, bus, address, payload = columns
        if times is None or bus is None or address is None or payload is None:
            return
        files = (times, bus, address, payload)
        if not (self._has(times, "iuf") and self._has(bus, "iu") and self._has(address, "iu")):
            return
        n = min(len(column.rows) for column in files)
        lost = max(column.declared for column in files) - n
        kind = payload.rows.dtype
        if kind.kind != "S" or kind.itemsize > 8 or payload.rows.ndim > 1:
            self._unreadable.append(f"{payload.path}: expected |S8, got {kind}")
            return
        buses = np.asarray(bus.rows[:n])
        t_ns = _to_ns(times.rows[:n])
        for number in np.unique(buses):
            index = np.flatnonzero(buses == number)
            # The bus of missing frames of a truncated file is unknown; the first bus reports them.
            missing = lost if number == buses.min() else 0
            topic = Topic(
                f"can/{int(number)}", "crosscue/CanFrames", "columns", declared=len(index) + missing
            )
            yield _Source(topic, t_ns[index], _frames_of(address, payload, index), files)


def _frames_of(
    address: ArrayColumn, payload: ArrayColumn, index: NDArray[np.intp]
) -> Callable[[slice], Rows]:
    def frames(part: slice) -> CanFrames:
        rows = index[part]
        ids = np.asarray(address.rows[rows])
        width = payload.rows.dtype.itemsize
        picked = np.ascontiguousarray(payload.rows[rows])
        # An element of |S8 drops trailing zero bytes; the underlying buffer still has them.
        raw = np.zeros((len(rows), 8), np.uint8)
        raw[:, :width] = picked.view(np.uint8).reshape(len(rows), width)
        return CanFrames(
            ids.astype(np.uint32),
            ids > 0x7FF,
            np.full(len(rows), DATA, np.uint8),
            np.full(len(rows), LENGTH_UNKNOWN, np.uint8),
            raw,
            np.zeros(len(rows), np.bool_),
        )

    return frames


def _block(source: _Source, part: slice, ledger: Ledger, selection: Selection) -> Iterator[Block]:
    name, count = source.topic.name, part.stop - part.start
    ledger.find(name, count)
    if not selection.wants(name):
        ledger.skip(name, NOT_ASKED_TOPIC, count)
        return
    block = Block(name, source.t_ns[part], source.rows(part))
    wanted = block.log_ns != NO_TIME
    timeless = int(count - wanted.sum())
    ledger.spoil(name, "a row without a valid time", timeless)
    wanted &= selection.inside(block.log_ns)
    ledger.skip(name, NOT_ASKED_TIME, int(count - timeless - wanted.sum()))
    if wanted.all():
        yield block
    elif wanted.any():
        yield block.take(wanted)


def _to_ns(seconds: Values) -> Int64s:
    """Convert seconds to nanoseconds, ``NO_TIME`` for damaged numbers that are not times."""
    with np.errstate(invalid="ignore", over="ignore"):
        t_ns = np.rint(np.asarray(seconds, np.float64) * 1e9)
        is_time = np.abs(t_ns) < LATEST_NS
    return np.where(is_time, t_ns, NO_TIME).astype(np.int64)


def open_segment(path: Path, limits: Limits) -> CommaSegment:
    """Open a segment folder; see ``crosscue.replay.formats.FORMATS``."""
    return CommaSegment(path)
