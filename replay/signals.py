"""From a log's blocks to the few signals that estimators take, by role.

``plan`` decides once, from the topics and the vehicle file, which topic gives which signal, and
says why where it cannot; ``Extractor`` then turns blocks into ``Samples``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from crosscue.replay.clocks.reports import MAX_OFFSET_NS, Clock, ClockWatch, times_of
from crosscue.replay.vehicle.roles import Role, role_of
from crosscue.replay.vehicle.vehicle import AngleSignal, Vehicle

from .columns import Block, Floats, Images, Int64s, Table, Topic
from .decode import Decoder, decoder_for
from .errors import MissingTopicError, VehicleError
from .ledger import Ledger

if TYPE_CHECKING:
    from crosscue.replay.can.database import CanDatabase
    from crosscue.replay.can.decode import BusDecoder
    from crosscue.replay.decode.packets import PacketDecoder
    from crosscue.replay.mobileye.samples import MobileyeStream

SPEED_UNITS: Final[Mapping[str, float]] = {
    "m/s": 1.0, "mps": 1.0, "km/h": 1 / 3.6, "kph": 1 / 3.6, "kmh": 1 / 3.6, "kmph": 1 / 3.6,
    "mph": 0.44704, "mi/h": 0.44704,
}  # fmt: skip
ANGLE_UNITS: Final[Mapping[str, float]] = {
    "rad": 1.0, "deg": np.pi / 180, "degree": np.pi / 180, "degrees": np.pi / 180,
    "°": np.pi / 180, "rad/s": 1.0, "deg/s": np.pi / 180, "degree/s": np.pi / 180,
    "degrees/s": np.pi / 180, "°/s": np.pi / 180, "deg/sec": np.pi / 180,
}  # fmt: skip


class Signal(Enum):
    """What estimators take; the value says shape and unit of the samples."""

    WHEEL_SPEEDS = "(N, 4) m/s: front left, front right, rear left, rear right; NaN where none"
    YAW_RATE = "(N,) rad/s, counter-clockwise"
    STEERING = "(N,) rad at the steering wheel, counter-clockwise"
    MAGNETIC_FIELD = "(N, 3) tesla, forward, left, up"
    HEADING = "(N,) rad from east, counter-clockwise"
    COURSE = "(N, 2) rad from east, counter-clockwise, and speed in m/s, of the ground track"
    MOBILEYE_OBSTACLES = "(N, 8) vehicles and when each picture was told; mobileye/samples.py"
    MOBILEYE_LANES = "(N, 8) lane lines left and right, as cubics; mobileye/samples.py"


MOBILEYE_SIGNALS: Final = (Signal.MOBILEYE_OBSTACLES, Signal.MOBILEYE_LANES)


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Consecutive readings of one signal.

    Attributes:
        signal: Which one.
        t_ns: Shape (N,), int64, log clock.
        values: Shape (N,) or (N, k); see ``Signal``.
    """

    signal: Signal
    t_ns: Int64s
    values: Floats

    def take(self, index: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Samples:
        """The readings picked by ``index``."""
        return Samples(self.signal, self.t_ns[index], self.values[index])


@dataclass(frozen=True, slots=True)
class Source:
    """One topic of one log and the signals it gives."""

    log: int
    topic: Topic
    signals: tuple[Signal, ...]


@dataclass(frozen=True, slots=True)
class Plan:
    """Which topics are read for which signals, and what is missing.

    Attributes:
        sources: In the order of logs and topics.
        missing: From a signal that nothing gives to the reason, in plain words.
    """

    sources: tuple[Source, ...]
    missing: Mapping[Signal, str]

    def topics_of(self, log: int) -> frozenset[str]:
        """Names to read from one log."""
        return frozenset(source.topic.name for source in self.sources if source.log == log)

    def source_of(self, signal: Signal) -> Source | None:
        """Who gives ``signal``."""
        return next((source for source in self.sources if signal in source.signals), None)


@dataclass(slots=True)
class _Planner:
    topics: Sequence[tuple[int, Topic]]
    vehicle: Vehicle
    chosen: dict[tuple[int, str], tuple[Topic, list[Signal]]] = field(default_factory=dict)
    missing: dict[Signal, str] = field(default_factory=dict)

    def only(self, role: Role, named: str | None, key: str) -> tuple[int, Topic] | None:
        """The topic named in the vehicle file, or the only one of the role.

        Raises:
            VehicleError: The named one is not there, or several could be meant.
        """
        if named is not None:
            found = [(log, topic) for log, topic in self.topics if topic.name == named]
            if not found:
                names = ", ".join(sorted(topic.name for _, topic in self.topics))
                raise MissingTopicError(f"{key} = {named!r}: no such topic; there are: {names}")
            return found[0]
        found = [(log, topic) for log, topic in self.topics if role_of(topic) is role]
        if len(found) > 1:
            names = ", ".join(topic.name for _, topic in found)
            raise VehicleError(
                f"several topics could be the {role.value}: {names}; name one as {key} in the "
                "vehicle file"
            )
        return found[0] if found else None

    def choose(self, place: tuple[int, Topic], signal: Signal) -> None:
        log, topic = place
        self.chosen.setdefault((log, topic.name), (topic, []))[1].append(signal)


def plan(topics: Sequence[tuple[int, Topic]], vehicle: Vehicle) -> Plan:
    """Choose a topic for every signal.

    Args:
        topics: All topics of all logs, each with its log's index.
        vehicle: The vehicle file.

    Raises:
        VehicleError: A named topic is not there, or several could be meant; lists them.
    """
    planner = _Planner(topics, vehicle)
    _plan_can(planner)
    _plan_odometry(planner)
    _plan_imu(planner)
    _plan_heading(planner)
    _plan_mobileye(planner)
    given = {signal for _, signals in planner.chosen.values() for signal in signals}
    sources = tuple(
        Source(log, topic, tuple(signals)) for (log, _), (topic, signals) in planner.chosen.items()
    )
    missing = {
        signal: planner.missing.get(signal, "no topic of a fitting type")
        for signal in Signal
        if signal not in given
    }
    return Plan(sources, missing)


def _plan_can(planner: _Planner) -> None:
    can = planner.vehicle.can
    wanted = [
        (can.wheel_speeds, Signal.WHEEL_SPEEDS),
        (can.yaw_rate, Signal.YAW_RATE),
        (can.steering, Signal.STEERING),
    ]
    if not any(section for section, _ in wanted):
        return
    if not can.dbc:
        raise VehicleError("can.dbc: missing; CAN signals are named but no DBC file to decode them")
    place = planner.only(Role.CAN, can.bus, "can.bus")
    for section, signal in wanted:
        if section is None:
            continue
        if place is None:
            planner.missing[signal] = "the log has no CAN bus"
        else:
            planner.choose(place, signal)


def _plan_odometry(planner: _Planner) -> None:
    if planner.vehicle.can.wheel_speeds is not None:
        return
    place = planner.only(Role.WHEELS, None, "topics.odometry")
    if place is not None:
        planner.choose(place, Signal.WHEEL_SPEEDS)
        return
    place = planner.only(Role.ODOMETRY, planner.vehicle.topics.odometry, "topics.odometry")
    if place is not None:
        planner.choose(place, Signal.WHEEL_SPEEDS)
        if planner.vehicle.can.yaw_rate is None:
            planner.choose(place, Signal.YAW_RATE)
        return
    planner.missing[Signal.WHEEL_SPEEDS] = (
        "no wheel speeds: name the bus, DBC and signals under [can] in the vehicle file"
    )


def _plan_imu(planner: _Planner) -> None:
    taken = {signal for _, signals in planner.chosen.values() for signal in signals}
    if Signal.YAW_RATE in taken:
        return
    place = planner.only(Role.IMU, planner.vehicle.topics.imu, "topics.imu")
    if place is not None:
        planner.choose(place, Signal.YAW_RATE)


def _plan_heading(planner: _Planner) -> None:
    names, compass = planner.vehicle.topics, planner.vehicle.compass
    if not compass.use:
        planner.missing[Signal.MAGNETIC_FIELD] = "compass.use is false in the vehicle file"
        planner.missing[Signal.HEADING] = planner.missing[Signal.MAGNETIC_FIELD]
    elif names.heading is not None:
        place = planner.only(Role.IMU, names.heading, "topics.heading")
        if place is not None:
            planner.choose(place, Signal.HEADING)
    else:
        place = planner.only(Role.MAGNETOMETER, names.magnetometer, "topics.magnetometer")
        if place is not None:
            planner.choose(place, Signal.MAGNETIC_FIELD)
    place = planner.only(Role.GNSS, names.gnss, "topics.gnss")
    if place is not None:
        planner.choose(place, Signal.COURSE)


def _plan_mobileye(planner: _Planner) -> None:
    """From the bus that the vehicle file names, else from messages; a log without is no error."""
    bus = planner.vehicle.mobileye.bus
    on_bus = [(log, topic) for log, topic in planner.topics if topic.name == bus]
    if on_bus and role_of(on_bus[0][1]) is Role.CAN:
        for signal in MOBILEYE_SIGNALS:
            planner.choose(on_bus[0], signal)
        return
    places = {
        name: [
            (log, topic)
            for log, topic in planner.topics
            if role_of(topic) is Role.MOBILEYE
            and topic.type_name.rpartition("/")[2] == name
            and topic.name.startswith(bus or "")
            and "next" not in topic.name.rpartition("/")[2].lower()
        ]
        for name in ("ObstacleStatus", "ObstacleData", "LkaLane")
    }
    if not any(places.values()):
        lacks = "mobileye.bus is not given" if bus is None else f"no topic {bus} (mobileye.bus)"
        reason = f"{lacks}, and there are no messages of mobileye_560_660_msgs"
        planner.missing.update(dict.fromkeys(MOBILEYE_SIGNALS, reason))
        return
    if len(places["ObstacleData"]) > 1:
        names = ", ".join(topic.name for _, topic in places["ObstacleData"])
        raise VehicleError(
            f"several topics could be the Mobileye's obstacles: {names}; give the beginning of one "
            "device's topics as mobileye.bus in the vehicle file"
        )
    for name, found in places.items():
        for place in found:
            lanes = name == "LkaLane"
            planner.choose(place, Signal.MOBILEYE_LANES if lanes else Signal.MOBILEYE_OBSTACLES)


def camera_of(topics: Sequence[tuple[int, Topic]], vehicle: Vehicle) -> tuple[int, Topic] | None:
    """The camera: the topic that the vehicle file names, or the only one; None where there is none.

    Raises:
        VehicleError: The named one is not there, or several could be meant.
    """
    return _Planner(topics, vehicle).only(Role.CAMERA, vehicle.topics.camera, "topics.camera")


def with_pictures(planned: Plan, camera: tuple[int, Topic]) -> Plan:
    """The same plan, with the camera's pictures read as well; see ``Extractor.on_pictures``."""
    log, topic = camera
    return replace(planned, sources=(*planned.sources, Source(log, topic, ())))


def _no_pictures(block: Block) -> None:
    """Let them pass."""


@dataclass(slots=True)
class Extractor:
    """Blocks of one log to samples; keeps what a bus needs from block to block.

    Attributes:
        planned: Which topics give which signals.
        vehicle: The vehicle file.
        log: Index of the log.
        ledger: Where skips are told.
        clocks: From a topic to the clock whose times its samples carry; the log's where none is.
        watch: Sees every block, decoded.
        on_pictures: Given every block of ``Images``, its ``log_ns`` on the clock chosen.
        shift_at: From drive time to how far it lies from the log's own, where blocks come in drive
            time; sensors' stamps are shifted alike.
    """

    planned: Plan
    vehicle: Vehicle
    log: int
    ledger: Ledger
    clocks: Mapping[str, Clock] = field(default_factory=dict)
    watch: ClockWatch = field(default_factory=ClockWatch)
    on_pictures: Callable[[Block], None] = _no_pictures
    shift_at: Callable[[Int64s], Int64s] | None = None
    _decoders: dict[str, Decoder | None] = field(default_factory=dict)
    _buses: dict[str, BusDecoder] = field(default_factory=dict)
    _mobileye: MobileyeStream | None = None
    _packets: dict[str, PacketDecoder] = field(default_factory=dict)

    def __call__(self, block: Block) -> Iterator[Samples]:
        """The samples of one block; rows that cannot be used are skipped in the ledger."""
        source = next(
            (s for s in self.planned.sources if s.log == self.log and s.topic.name == block.topic),
            None,
        )
        if source is None:
            return
        if source.topic.encoding != "columns":
            if block.topic not in self._decoders:
                self._decoders[block.topic] = decoder_for(source.topic)
            decode = self._decoders[block.topic]
            if decode is None:
                self.ledger.skip(block.topic, "type not understood", len(block))
                return
            block = decode(block, self.ledger)
        if not len(block):
            return
        if self.shift_at is not None and block.header_ns is not None:
            block = replace(block, header_ns=self._shifted(block.header_ns, block.log_ns))
        self.watch.see(block)
        clock = self.clocks.get(block.topic, Clock.LOG)
        block = replace(block, log_ns=times_of(block, clock))
        if not {*source.signals}.isdisjoint(MOBILEYE_SIGNALS):
            yield from self._mobileye_stream(source)(block)
        if role_of(source.topic) is Role.CAN:
            if not {*source.signals} <= {*MOBILEYE_SIGNALS}:
                yield from self._from_can(block, source)
            return
        if isinstance(block.rows, Images):
            self._show(block, block.rows)
        for signal in source.signals:
            if signal not in MOBILEYE_SIGNALS:
                yield from _FROM_TABLE[signal](block, self.ledger)

    def _shifted(self, header_ns: Int64s, log_ns: Int64s) -> Int64s:
        """Sensors' stamps in drive time; 0, for none, where they did not follow the log's clock."""
        assert self.shift_at is not None
        shifted = header_ns + self.shift_at(log_ns)
        follows = (header_ns > 0) & (np.abs(shifted - log_ns) <= MAX_OFFSET_NS)
        return np.where(follows, shifted, 0)

    def finish(self) -> Iterator[tuple[str, Samples]]:
        """What was held back until it was known to be whole, with its topic; at the log's end.

        The last pictures of a video stream go to ``on_pictures``.
        """
        for packets in self._packets.values():
            for block in packets.flush():
                self.on_pictures(block)
        if self._mobileye is not None:
            source = self._mobileye_sources()[0]
            for samples in self._mobileye.flush():
                yield source.topic.name, samples

    def _show(self, block: Block, images: Images) -> None:
        """Pictures to whoever looks at them, packets of a video decoded first."""
        from crosscue.replay.decode.packets import PacketDecoder, is_stream

        if self.on_pictures is _no_pictures:
            return
        if not is_stream(images):
            self.on_pictures(block)
            return
        if block.topic not in self._packets:
            self._packets[block.topic] = PacketDecoder(block.topic, self.ledger)
        for shown in self._packets[block.topic](block):
            self.on_pictures(shown)

    def _mobileye_sources(self) -> list[Source]:
        return [
            source
            for source in self.planned.sources
            if source.log == self.log and not {*source.signals}.isdisjoint(MOBILEYE_SIGNALS)
        ]

    def _mobileye_stream(self, source: Source) -> MobileyeStream:
        if self._mobileye is None:
            from crosscue.replay.mobileye.samples import MobileyeStream

            types = {
                one.topic.name: one.topic.type_name
                for one in self._mobileye_sources()
                if role_of(one.topic) is Role.MOBILEYE
            }
            self._mobileye = MobileyeStream(
                source.topic.name,
                self.ledger,
                self.vehicle.mobileye,
                types,
                is_shared_bus=not {*source.signals} <= {*MOBILEYE_SIGNALS},
            )
        return self._mobileye

    def _from_can(self, block: Block, source: Source) -> Iterator[Samples]:
        decoder = self._bus_decoder(source)
        tables = {part.topic.rsplit("/", 1)[1]: part for part in decoder(block)}
        can = self.vehicle.can
        if can.wheel_speeds is not None:
            wheels = can.wheel_speeds
            names = (wheels.front_left, wheels.front_right, wheels.rear_left, wheels.rear_right)
            scales = dict(SPEED_UNITS)
            if wheels.wheel_radius_m is not None:
                scales["rad/s"] = wheels.wheel_radius_m
            columns = [
                _column(tables, name, wheels.unit, scales, "can.wheel_speeds") for name in names
            ]
            yield from _wheel_samples(columns)
        for section, signal, key in (
            (can.yaw_rate, Signal.YAW_RATE, "can.yaw_rate"),
            (can.steering, Signal.STEERING, "can.steering"),
        ):
            if section is not None:
                yield from _angle_samples(tables, section, signal, key)

    def _bus_decoder(self, source: Source) -> BusDecoder:
        bus = source.topic.name
        if bus not in self._buses:
            from crosscue.replay.can.decode import BusDecoder
            from crosscue.replay.mobileye.admit import all_ids
            from crosscue.replay.mobileye.samples import settings_of

            database = _database(self.vehicle.can.dbc)
            for sentence in database.notices:
                self.ledger.notice(sentence)
            wanted = check_signals(database, self.vehicle)
            is_shared = not {*source.signals}.isdisjoint(MOBILEYE_SIGNALS)
            settings = settings_of(self.vehicle.mobileye, is_shared_bus=is_shared)
            elsewhere = all_ids(settings) if is_shared else ()
            self._buses[bus] = BusDecoder(database, bus, self.ledger, wanted, elsewhere=elsewhere)
        return self._buses[bus]


@lru_cache(maxsize=8)
def _database(files: tuple[str, ...]) -> CanDatabase:
    """Read once for the probe of the clocks and the run."""
    from crosscue.replay.can.database import CanDatabase

    return CanDatabase.load([Path(name) for name in files])


def check_signals(database: CanDatabase, vehicle: Vehicle) -> frozenset[tuple[str, str]]:
    """The (message, signal) pairs that the vehicle file names, each known to the database.

    Raises:
        VehicleError: A name that the database does not hold; with the nearest one.
    """
    import difflib

    known = {f"{m.name}.{s.name}" for m in database.messages for s in m.signals}
    pairs: set[tuple[str, str]] = set()
    for key, name in _named_signals(vehicle):
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
            hint = f"did you mean {close[0]}?" if close else "look it up in the DBC file"
            raise VehicleError(f"{key} = {name!r}: no such signal in {vehicle.can.dbc}; {hint}")
        message, _, signal = name.partition(".")
        pairs.add((message, signal))
    return frozenset(pairs)


def _named_signals(vehicle: Vehicle) -> Iterator[tuple[str, str]]:
    can = vehicle.can
    if can.wheel_speeds is not None:
        for wheel in ("front_left", "front_right", "rear_left", "rear_right"):
            name = getattr(can.wheel_speeds, wheel)
            if name is not None:
                yield f"can.wheel_speeds.{wheel}", name
    if can.yaw_rate is not None:
        yield "can.yaw_rate.signal", can.yaw_rate.signal
    if can.steering is not None:
        yield "can.steering.signal", can.steering.signal


@dataclass(frozen=True, slots=True, eq=False)
class _Column:
    t_ns: Int64s
    values: Floats


def _column(
    tables: Mapping[str, Block],
    name: str | None,
    unit: str | None,
    scales: Mapping[str, float],
    key: str,
) -> _Column | None:
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


def _wheel_samples(columns: Sequence[_Column | None]) -> Iterator[Samples]:
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
        # Wheels in different messages: each takes the other's nearest earlier reading.
        at = np.searchsorted(column.t_ns, base.t_ns, side="right") - 1
        speeds[:, i] = np.where(at >= 0, column.values[np.maximum(at, 0)], np.nan)
    yield Samples(Signal.WHEEL_SPEEDS, base.t_ns, speeds)


def _angle_samples(
    tables: Mapping[str, Block], section: AngleSignal, signal: Signal, key: str
) -> Iterator[Samples]:
    column = _column(tables, section.signal, section.unit, ANGLE_UNITS, key)
    if column is not None and len(column.t_ns):
        yield Samples(signal, column.t_ns, column.values * section.sign)


def _table(block: Block, ledger: Ledger, *names: str) -> Table | None:
    if isinstance(block.rows, Table) and all(name in block.rows.columns for name in names):
        return block.rows
    ledger.skip(block.topic, "lacks a column its role needs", len(block), ", ".join(names))
    return None


def _wheels(block: Block, ledger: Ledger) -> Iterator[Samples]:
    if isinstance(block.rows, Table) and "speed_x_mps" in block.rows.columns:
        speed = np.asarray(block.rows["speed_x_mps"], np.float64)
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
    # A fix without course and speed is no fault: most receivers' messages carry neither.
    if isinstance(block.rows, Table) and {"course_rad", "speed_mps"} <= set(block.rows.columns):
        columns = [np.asarray(block.rows[name], float) for name in ("course_rad", "speed_mps")]
        yield Samples(Signal.COURSE, block.log_ns, np.stack(columns, axis=1))


_FROM_TABLE: Final[Mapping[Signal, Callable[[Block, Ledger], Iterator[Samples]]]] = {
    Signal.WHEEL_SPEEDS: _wheels,
    Signal.YAW_RATE: _one_of(Signal.YAW_RATE, "gyro_z_radps", "yaw_rate_radps"),
    Signal.STEERING: _one_of(Signal.STEERING, "steering_rad"),
    Signal.MAGNETIC_FIELD: _magnetic,
    Signal.HEADING: _heading,
    Signal.COURSE: _course,
}
