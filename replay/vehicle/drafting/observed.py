"""Observations from the first minutes of a drive: CAN buses and signals of the car's motion."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from crosscue.replay.base import Log, Selection, name_of
from crosscue.replay.columns import LENGTH_UNKNOWN, Block, CanFrames, Floats, Int64s, Table
from crosscue.replay.decode import decoder_for
from crosscue.replay.ledger import Ledger, warn_of
from crosscue.replay.vehicle.roles import Role, is_table, role_of

from .candidates import Candidate, SignalKind, candidates
from .series import GroundTrack, Series

if TYPE_CHECKING:
    from crosscue.replay.can.database import CanDatabase
    from crosscue.replay.can.decode import BusDecoder

# Observed time: five minutes contain some bends and stops, and are read in seconds.
OBSERVED_NS: Final = 300_000_000_000
# Minimum number of its messages, including the status, that identify a Mobileye's bus. Identifiers
# of other devices may coincide, but not with these lengths and in this number.
MOBILEYE_MESSAGES: Final = 4


@dataclass(slots=True, eq=False)
class Bus:
    """One CAN bus of the drive.

    Attributes:
        topic: Name of the topic.
        frames: Number of frames examined.
        ids: Payload lengths by identifier and the flag for extended identifiers.
        known: Number of these identifiers in the database.
        signals: Candidate signals with their readings in SI units.
    """

    topic: str
    frames: int = 0
    ids: dict[tuple[int, bool], set[int]] = field(default_factory=dict)
    known: int = 0
    signals: list[tuple[Candidate, Series]] = field(default_factory=list)

    @property
    def mobileye(self) -> tuple[str, ...]:
        """Names of a Mobileye's messages on the bus; empty if it is not a Mobileye's bus."""
        from crosscue.replay.mobileye.layout import layout

        found = []
        for message in layout().values():
            fits = {*message.lengths, LENGTH_UNKNOWN}
            seen = [self.ids.get((one, False)) for one in message.ids]
            if any(lengths is not None and lengths <= fits for lengths in seen):
                found.append(message.name)
        is_mobileye = "status" in found and len(found) >= MOBILEYE_MESSAGES
        return tuple(found) if is_mobileye else ()


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Observations from a drive.

    Attributes:
        buses: CAN buses, those with most known identifiers first.
        tracks: Speed and course over ground of every topic that reports them.
        yaw_rates: Yaw rates of inertial units and odometry, by topic.
        speeds: Speeds of wheel-speed and odometry topics, by topic.
        tables: Speeds of tables without a role, by topic, if there are no such topics.
        start_ns: Earliest time observed.
        end_ns: Latest time observed.
    """

    buses: tuple[Bus, ...]
    tracks: tuple[GroundTrack, ...]
    yaw_rates: tuple[Series, ...]
    speeds: tuple[Series, ...]
    start_ns: int
    end_ns: int
    tables: tuple[Series, ...] = ()

    def of_kind(self, kind: SignalKind) -> list[tuple[Bus, Candidate, Series]]:
        """Return the candidate signals of a kind with their buses."""
        return [
            (bus, candidate, series)
            for bus in self.buses
            for candidate, series in bus.signals
            if candidate.kind is kind and len(series) > 1
        ]


_MOTION: Final = (Role.GNSS, Role.IMU, Role.ODOMETRY, Role.WHEELS)
_SPEED: Final = (Role.ODOMETRY, Role.WHEELS)


def observe(logs: Sequence[Log], database: CanDatabase | None) -> Observed:
    """Read the first minutes of every log, and warn of losses in them."""
    found = _Collected(database)
    has_speed = any(role_of(topic) in _SPEED for log in logs for topic in log.topics)
    for log in logs:
        roles = {
            topic.name: role
            for topic in log.topics
            if (role := role_of(topic)) is Role.CAN
            or role in _MOTION
            or (is_table(topic) and not has_speed)
        }
        if roles:
            _read(log, roles, found)
    return found.result()


def _read(log: Log, roles: Mapping[str, Role | None], found: _Collected) -> None:
    ledger = Ledger(name_of(log))
    decoders = {
        topic.name: decoder_for(topic) if topic.encoding != "columns" else None
        for topic in log.topics
        if topic.name in roles
    }
    first_ns: int | None = None
    for name, role in roles.items():
        if role is Role.CAN:
            found.buses.setdefault(name, Bus(name))
    for block in log.read(ledger, Selection(frozenset(roles))):
        if not len(block):
            continue
        decode = decoders[block.topic]
        shown = decode(block, ledger) if decode is not None else block
        first_ns = int(block.log_ns[0]) if first_ns is None else first_ns
        if int(block.log_ns[0]) - first_ns > OBSERVED_NS:
            break
        found.take(shown, roles[block.topic])
    warn_of(ledger)


class _Collected:
    """Collects readings from blocks and converts them to series."""

    def __init__(self, database: CanDatabase | None) -> None:
        self.buses: dict[str, Bus] = {}
        self._database: Final = database
        found = [] if database is None else [*candidates(database.messages)]
        self._candidates: Final = {(one.message, one.signal): one for one in found}
        self._decoders: dict[str, BusDecoder] = {}
        self._parts: dict[tuple[str, str], dict[str, list[tuple[Int64s, Floats]]]] = {}
        self._first_ns: list[int] = []
        self._last_ns: list[int] = []

    def take(self, block: Block, role: Role | None) -> None:
        """Add a decoded block of a topic; a table without a role only if it has a speed."""
        if not len(block) or (role is None and not _has_speed(block)):
            return
        self._first_ns.append(int(block.log_ns.min()))
        self._last_ns.append(int(block.log_ns.max()))
        if isinstance(block.rows, CanFrames):
            self._take_frames(block, block.rows)
        elif isinstance(block.rows, Table) and role is not Role.CAN:
            for column in _COLUMNS[role]:
                if column in block.rows.columns:
                    values = np.asarray(block.rows[column], np.float64)
                    part = "" if role is None else role.name
                    self._add(block.topic, part, column, block.log_ns, values)

    def _take_frames(self, block: Block, rows: CanFrames) -> None:
        bus = self.buses.setdefault(block.topic, Bus(block.topic))
        bus.frames += len(block)
        key = rows.arbitration_id.astype(np.int64) | rows.is_extended.astype(np.int64) << 32
        for one in np.unique(key | rows.length.astype(np.int64) << 40).tolist():
            place = (one & 0xFFFF_FFFF, bool(one >> 32 & 1))
            bus.ids.setdefault(place, set()).add(one >> 40)
        if not self._candidates:
            return
        for part in self._decoder(block.topic)(block):
            if not isinstance(part.rows, Table):
                continue
            message = part.topic.rsplit("/", 1)[1]
            for signal in part.rows.columns:
                if (one := self._candidates.get((message, signal))) is not None:
                    values = np.asarray(part.rows[signal], np.float64) * one.scale
                    self._add(block.topic, message, signal, part.log_ns, values)

    def _decoder(self, bus: str) -> BusDecoder:
        if bus not in self._decoders:
            from crosscue.replay.can.decode import BusDecoder

            assert self._database is not None
            self._decoders[bus] = BusDecoder(
                self._database, bus, Ledger(""), frozenset(self._candidates)
            )
        return self._decoders[bus]

    def _add(self, topic: str, part: str, column: str, t_ns: Int64s, values: Floats) -> None:
        columns = self._parts.setdefault((topic, part), {})
        columns.setdefault(column, []).append((t_ns, values))

    def result(self) -> Observed:
        """Return the collected observations."""
        columns: dict[tuple[str, str], _Columns] = {
            place: {name: _joined(parts) for name, parts in found.items()}
            for place, found in self._parts.items()
        }
        for (topic, message), found in columns.items():
            for signal, readings in found.items():
                one = self._candidates.get((message, signal))
                if topic in self.buses and one is not None:
                    self.buses[topic].signals.append((one, Series.of(one.name, *readings)))
        if self._database is not None:
            for bus in self.buses.values():
                bus.known = sum(self._database.find(*key) is not None for key in bus.ids)
        known_first = sorted(self.buses.values(), key=lambda bus: (-bus.known, bus.topic))
        return Observed(
            tuple(known_first),
            tuple(
                track
                for (topic, part), found in columns.items()
                if part == Role.GNSS.name and (track := _track(topic, found)) is not None
            ),
            tuple(_series(columns, (Role.IMU, Role.ODOMETRY), _YAW_COLUMNS)),
            tuple(_series(columns, _SPEED, _SPEED_COLUMNS)),
            *self._span_ns(),
            tuple(_series(columns, (None,), _TABLE_COLUMNS)),
        )

    def _span_ns(self) -> tuple[int, int]:
        """Return the earliest and latest time, without damaged times that may be years away."""
        if not self._first_ns:
            return 0, 0
        middle_ns = sorted(self._first_ns)[len(self._first_ns) // 2]
        return (
            max(min(self._first_ns), middle_ns - OBSERVED_NS),
            min(max(self._last_ns), middle_ns + OBSERVED_NS),
        )


def _joined(parts: Sequence[tuple[Int64s, Floats]]) -> tuple[Int64s, Floats]:
    t_ns, values = (np.concatenate(column) for column in zip(*parts, strict=True))
    return t_ns, values


_Columns = Mapping[str, tuple[Int64s, Floats]]
_YAW_COLUMNS: Final = ("gyro_z_radps", "yaw_rate_radps")
_SPEED_COLUMNS: Final = ("speed_x_mps", "rear_left_mps")
_TABLE_COLUMNS: Final = ("speed_x_mps", "speed_mps")
_COLUMNS: Final[dict[Role | None, tuple[str, ...]]] = {
    None: _TABLE_COLUMNS,
    Role.GNSS: (
        "speed_mps",
        "course_rad",
        "velocity_east_mps",
        "velocity_north_mps",
        "latitude_deg",
        "longitude_deg",
    ),
    Role.IMU: _YAW_COLUMNS,
    Role.ODOMETRY: ("speed_x_mps", *_YAW_COLUMNS),
    Role.WHEELS: _SPEED_COLUMNS,
}


def _has_speed(block: Block) -> bool:
    """Return whether a table has the car's speed; with positions, the speed is from GNSS."""
    names = block.rows.columns.keys() if isinstance(block.rows, Table) else ()
    return not {*_TABLE_COLUMNS}.isdisjoint(names) and "latitude_deg" not in names


def _series(
    columns: Mapping[tuple[str, str], _Columns], roles: Iterable[Role | None], wanted: Sequence[str]
) -> Iterable[Series]:
    names = {"" if role is None else role.name for role in roles}
    for (topic, part), found in columns.items():
        name = next((name for name in wanted if name in found), None)
        if part in names and name is not None:
            yield Series.of(topic, *found[name])


def _track(topic: str, found: _Columns) -> GroundTrack | None:
    """Return the track that a topic reports, or one derived from its positions."""
    if {"speed_mps", "course_rad"} <= found.keys():
        t_ns, speed = found["speed_mps"]
        return GroundTrack.of_course(topic, t_ns, speed, found["course_rad"][1])
    if {"velocity_east_mps", "velocity_north_mps"} <= found.keys():
        t_ns, east = found["velocity_east_mps"]
        return GroundTrack.of_velocity(topic, t_ns, east, found["velocity_north_mps"][1])
    if {"latitude_deg", "longitude_deg"} <= found.keys():
        t_ns, latitude = found["latitude_deg"]
        return GroundTrack.of_positions(topic, t_ns, latitude, found["longitude_deg"][1])
    return None
