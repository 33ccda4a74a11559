"""openpilot: the segment of a route with CAN, camera, IMU, GNSS, calibration and car state.

A folder has ``rlog`` (or the decimated ``qlog``; plain, ``.bz2`` or ``.zst``), a stream of Cap'n
Proto messages, and the videos ``fcamera.hevc`` and ``qcamera.ts``. Log times are those of the
device's boot clock. All CAN frames of one message share its time; a video's frame has the time at
which its exposure ended. Sensor axes [up, left, back], as the device is mounted, are converted to
REP-103's [forward, left, up] on reading. Buses from 128 on hold frames that the device sent.

The positions of fields are those that Cap'n Proto's encoding assigns to openpilot's ``log.capnp``.
"""

import bz2
import io
import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple, cast

import numpy as np

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import DATA, Block, CanFrames, Int64s, Table, Topic
from crosscue.replay.errors import LogFormatError
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.readers.can_rows import bus_topic
from crosscue.replay.readers.held_rows import CameraDrive, HeldRows, Loss, Numbers
from crosscue.replay.readers.images.video import Video
from crosscue.replay.readers.time_file import TimeFile
from crosscue.replay.seal.touched import Touched, open_noted

from .capnp import MessageError, Struct, messages

LOGS: Final = tuple(f"{kind}{end}" for kind in ("rlog", "qlog") for end in ("", ".bz2", ".zst"))
# Videos, and the messages that state the times of their frames, the first that the log has.
CAMERAS: Final = {"fcamera.hevc": (14,), "qcamera.ts": (88, 14)}
# Kinds of messages: the tags of the union in ``Event``.
CAN, SENSORS, CALIBRATION, CAR_STATE = 4, 10, 18, 21
GNSS: Final = {47: "gnss/external", 20: "gnss/internal"}
SENSOR: Final = {96: "imu/accelerometer", 97: "imu/gyro"}
# Tags of the union in ``SensorEventData``.
READINGS: Final = {0: "imu/accelerometer", 3: "imu/gyro", 6: "imu/gyro"}
FRAME_TIMES: Final = (14, 88)
OTHER: Final = "other messages"
NOT_READ: Final = "a kind of message that is not read"
DAMAGED: Final = "a message that cannot be parsed"
CUT: Final = "file is cut or damaged"

Row = tuple[float, ...]


class _Stream(NamedTuple):
    type_name: str
    columns: tuple[str, ...]


STREAMS: Final = {
    "car/wheel_speed": _Stream(
        "crosscue/WheelSpeeds",
        ("front_left_mps", "front_right_mps", "rear_left_mps", "rear_right_mps"),
    ),
    "car/speed": _Stream("crosscue/Table", ("speed_mps", "accel_x_mps2")),
    "car/steering_angle": _Stream("crosscue/Table", ("steering_deg",)),
    "imu/gyro": _Stream("sensor_msgs/msg/Imu", ("gyro_x_radps", "gyro_y_radps", "gyro_z_radps")),
    "imu/accelerometer": _Stream(
        "crosscue/Table", ("accel_x_mps2", "accel_y_mps2", "accel_z_mps2")
    ),
    "camera/calibration": _Stream(
        "crosscue/Table", ("roll_rad", "pitch_rad", "yaw_rad", "height_m", "is_calibrated")
    ),
    **dict.fromkeys(
        GNSS.values(),
        _Stream(
            "sensor_msgs/msg/NavSatFix",
            (
                "latitude_deg",
                "longitude_deg",
                "altitude_m",
                "position_sd_m",
                "speed_mps",
                "course_rad",
                "utc_ms",
            ),
        ),
    ),
}


def _car_state(event: Struct) -> Iterator[tuple[str, Row]]:
    state = event.struct(0)
    wheels = state.struct(1)
    yield "car/wheel_speed", tuple(wheels.number("f", 4 * i) for i in range(4))
    yield "car/speed", (state.number("f", 0), state.number("f", 28))
    yield "car/steering_angle", (state.number("f", 16),)


def _fix(event: Struct, topic: str) -> Iterator[tuple[str, Row]]:
    fix = event.struct(0)
    course_rad = math.radians(90.0 - fix.number("f", 32))
    place = tuple(fix.number("d", at) for at in (8, 16, 24))
    motion = (fix.number("f", 36), fix.number("f", 4), math.remainder(course_rad, math.tau))
    yield topic, (*place, *motion, fix.number("q", 40))


def _reading(reading: Struct) -> Iterator[tuple[str, Row]]:
    topic = READINGS.get(int(reading.number("H", 12)))
    if topic is None:
        return
    up_left_back = reading.struct(0).floats(0)
    if len(up_left_back) < 3:
        raise MessageError("expected three axes")
    up, left, back = up_left_back[:3]
    yield topic, (-back, left, up)


def _calibration(event: Struct) -> Iterator[tuple[str, Row]]:
    found = event.struct(0)
    angles, height_m = found.floats(4), found.floats(7)
    if len(angles) != 3:
        return
    # Device axes [forward, right, down]: pitch and yaw change their signs.
    roll_rad, pitch_rad, yaw_rad = angles
    status = found.number("H", 2)
    height = height_m[0] if height_m else math.nan
    yield "camera/calibration", (roll_rad, -pitch_rad, -yaw_rad, height, float(status == 1))


@dataclass(slots=True)
class _Held:
    """What a log holds, by topic.

    Attributes:
        rows: Times and rows of topics with numbers.
        frames: Time, identifier and payload of each CAN frame, by bus.
        frame_ns: Times of frames by kind of message and index in the segment's video.
        other: Number of messages of each kind that is not read.
        damaged: Number of messages that cannot be parsed, and the first reason.
        losses: Why the file's end was not reached.
    """

    rows: dict[str, tuple[list[int], list[Row]]] = field(default_factory=dict)
    frames: dict[int, list[tuple[int, int, bytes]]] = field(default_factory=dict)
    frame_ns: dict[int, dict[int, int]] = field(default_factory=dict)
    other: Counter[int] = field(default_factory=Counter)
    damaged: int = 0
    why: str = ""
    losses: list[Loss] = field(default_factory=list)

    def add(self, event: Struct) -> None:
        """Add a message.

        Raises:
            MessageError: It is damaged; nothing of it is added.
        """
        t_ns, kind = int(event.number("Q", 0)), int(event.number("H", 8))
        if t_ns >> 62:
            raise MessageError("a time beyond the year 2116")
        if kind == CAN:
            found = [
                (int(one.number("B", 6)), int(one.number("I", 0)), one.blob(0))
                for one in event.structs(0)
            ]
            if any(len(payload) > 64 for _, _, payload in found):
                raise MessageError("a CAN frame of over 64 bytes")
            for bus, identifier, payload in found:
                self.frames.setdefault(bus, []).append((t_ns, identifier, payload))
            return
        if kind in FRAME_TIMES:
            index = event.struct(0)
            times = self.frame_ns.setdefault(kind, {})
            times[int(index.number("I", 16))] = int(index.number("Q", 32)) or t_ns
            return
        found_rows = list(_rows(event, kind))
        if not found_rows:
            self.other[kind] += 1
        for topic, row in found_rows:
            stamps, rows = self.rows.setdefault(topic, ([], []))
            stamps.append(t_ns)
            rows.append(row)


def _rows(event: Struct, kind: int) -> Iterator[tuple[str, Row]]:
    """Yield the rows of a message; none of a kind that is not read."""
    if kind == CAR_STATE:
        yield from _car_state(event)
    elif kind == CALIBRATION:
        yield from _calibration(event)
    elif kind in GNSS:
        yield from _fix(event, GNSS[kind])
    elif kind in SENSOR:
        yield from _reading(event.struct(0))
    elif kind == SENSORS:
        for reading in event.structs(0):
            yield from _reading(reading)


@dataclass(frozen=True, slots=True, eq=False)
class _OtherMessages:
    """Messages of kinds that are not read, all skipped."""

    kinds: Counter[int]
    losses: tuple[Loss, ...]

    @property
    def topics(self) -> tuple[Topic, ...]:
        return ()

    def read(self, ledger: Ledger, selection: Selection) -> Iterator[Block]:
        ledger.declare(OTHER, self.kinds.total())
        ledger.find(OTHER, self.kinds.total())
        for kind, count in sorted(self.kinds.items()):
            ledger.skip(OTHER, NOT_READ, count, f"kind {kind} of log.capnp's Event")
        self.report_missing(ledger)
        yield from ()

    def report_missing(self, ledger: Ledger) -> None:
        """Report what could not be read of the file; see ``KnowsItsEnd``."""
        for loss in self.losses:
            ledger.drop("", *loss)


class OpenpilotSegment(CameraDrive):
    """The folder of one segment as a ``Log``."""

    format: Final = "openpilot"

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Read all streams, in order of their first times; see ``Log.read``."""
        yield from super().read(ledger, selection)
        ledger.integrity = "not checkable: no checksums, and a missing message cannot be detected"

    def close(self) -> None:
        """Close the videos."""
        for one in self._numbers:
            if isinstance(one, Video):
                one.close()


def open_openpilot(path: Path, limits: Limits) -> OpenpilotSegment:
    """Open a segment's folder; see ``crosscue.replay.formats.FORMATS``.

    Raises:
        LogFormatError: The log has no message.
    """
    there = [name for name in LOGS if (path / name).is_file()]
    if not there:
        raise LogFormatError(f"{path}: expected one of {', '.join(LOGS)}; found none")
    log, touched = path / there[0], Touched()
    held = _read(log, limits, touched)
    if not (held.rows or held.frames or held.frame_ns or held.other):
        why = held.losses[0].detail if held.losses else "it is empty"
        raise LogFormatError(f"{log}: no message of an openpilot log ({why}); copy it again")
    notices = []
    if log.name.startswith("qlog"):
        notices.append("qlog: the device kept few of the CAN frames and readings; rlog has all")
    numbers: list[Numbers] = [_numbers(name, *rows) for name, rows in held.rows.items()]
    numbers += [_frames(bus, frames) for bus, frames in sorted(held.frames.items())]
    losses = list(held.losses)
    if held.damaged:
        losses.append(Loss(DAMAGED, held.damaged, held.why))
    numbers.append(_OtherMessages(held.other, tuple(losses)))
    unreadable = []
    for name, kinds in CAMERAS.items():
        file = path / name
        if not file.is_file():
            continue
        try:
            numbers.append(_video(file, held, kinds, limits, touched))
        except LogFormatError as error:
            unreadable.append((file.stem, "video cannot be read", None, str(error)))
    return OpenpilotSegment(
        path, (), numbers, limits, touched, unreadable=unreadable, notices=notices
    )


def _read(log: Path, limits: Limits, touched: Touched) -> _Held:
    held = _Held()
    with open_noted(log, touched) as file:
        try:
            read = _bounded(_inflated(log, file), limits)
            for body, edges in messages(read, limits.message_bytes):
                try:
                    held.add(Struct.root(body, edges))
                except MessageError as error:
                    held.damaged += 1
                    held.why = held.why or str(error)
        except _failures() as error:
            held.losses.append(Loss(CUT, None, f"{log.name}: {error}"))
    return held


def _inflated(log: Path, file: io.BufferedReader) -> BinaryIO:
    if log.suffix == ".bz2":
        return cast("BinaryIO", bz2.BZ2File(file))
    if log.suffix == ".zst":
        import zstandard

        reader = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
        return cast("BinaryIO", io.BufferedReader(cast("io.RawIOBase", reader)))
    return file


def _bounded(file: BinaryIO, limits: Limits) -> Callable[[int], bytes]:
    """Return a function that reads, and fails after as many bytes as a container may have."""
    left = limits.chunk_bytes

    def read(size: int) -> bytes:
        nonlocal left
        found = file.read(size)
        left -= len(found)
        if left < 0:
            raise MessageError(f"over {limits.chunk_bytes} bytes; raise --max-chunk")
        return found

    return read


def _failures() -> tuple[type[Exception], ...]:
    import zstandard

    return MessageError, EOFError, OSError, zstandard.ZstdError


def _numbers(name: str, t_ns: list[int], rows: list[Row]) -> HeldRows:
    stream = STREAMS[name]
    times = np.array(t_ns, np.int64)
    order = np.argsort(times, kind="stable")
    values = np.array(rows, np.float64)[order]
    table = Table({column: values[:, i] for i, column in enumerate(stream.columns)})
    topic = Topic(name, stream.type_name, "columns", declared=len(times))
    return HeldRows(topic, times[order], table)


def _frames(bus: int, frames: list[tuple[int, int, bytes]]) -> HeldRows:
    n = len(frames)
    length = np.array([len(payload) for _, _, payload in frames], np.uint8)
    width = 8 if length.max(initial=0) <= 8 else 64
    padded = b"".join(payload.ljust(width, b"\0") for _, _, payload in frames)
    identifier = np.array([one for _, one, _ in frames], np.uint32)
    times = np.array([t_ns for t_ns, _, _ in frames], np.int64)
    order = np.argsort(times, kind="stable")
    rows = CanFrames(
        identifier,
        identifier > 0x7FF,
        np.full(n, DATA, np.uint8),
        length,
        np.frombuffer(padded, np.uint8).reshape(n, width),
        length > 8,
        np.full(n, bus >= 128, np.bool_),
    )
    return HeldRows(bus_topic(f"can/{bus}", n), times[order], rows.take(order))


def _video(
    file: Path, held: _Held, kinds: tuple[int, ...], limits: Limits, touched: Touched
) -> Video:
    times = next((held.frame_ns[kind] for kind in kinds if kind in held.frame_ns), {})
    last = max(times, default=-1) + 1
    t_ns: Int64s = np.array([times.get(i, -1) for i in range(last)], np.int64)
    if not last:
        raise LogFormatError(f"{file}: the log has no times of its frames")
    stream = cast("BinaryIO", open_noted(file, touched))
    try:
        return Video(file, stream, TimeFile(file, t_ns, None, None), limits)
    except BaseException:
        stream.close()
        raise
