"""Plan which topic carries which signal, from a log's topics and the vehicle file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from crosscue.replay.columns import Topic
from crosscue.replay.errors import MissingTopicError, VehicleError
from crosscue.replay.vehicle.roles import Role, role_of

from .kinds import MOBILEYE_SIGNALS, Signal, SignalPlan, SignalSource

if TYPE_CHECKING:
    from crosscue.replay.vehicle.vehicle import Vehicle


@dataclass(slots=True)
class _Planner:
    topics: Sequence[tuple[int, Topic]]
    vehicle: Vehicle
    chosen: dict[tuple[int, str], tuple[Topic, list[Signal]]] = field(default_factory=dict)
    missing: dict[Signal, str] = field(default_factory=dict)

    def only(self, role: Role, named: str | None, key: str) -> tuple[int, Topic] | None:
        """Return the topic named in the vehicle file, or the only topic of the role.

        Raises:
            VehicleError: The named topic does not exist, or there are several candidates.
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
        if signal is Signal.WHEEL_SPEEDS and self.vehicle.odometry.kind == "visual":
            self.missing[signal] = 'odometry.kind = "visual"'
            return
        log, topic = place
        self.chosen.setdefault((log, topic.name), (topic, []))[1].append(signal)


def plan(topics: Sequence[tuple[int, Topic]], vehicle: Vehicle) -> SignalPlan:
    """Choose a topic for every signal.

    Args:
        topics: All topics of all logs, each with its log's index.
        vehicle: The vehicle file.

    Raises:
        VehicleError: A named topic does not exist, or there are several candidates; the message
            lists them.
    """
    planner = _Planner(topics, vehicle)
    _plan_can(planner)
    _plan_odometry(planner)
    _plan_imu(planner)
    _plan_heading(planner)
    _plan_mobileye(planner)
    given = {signal for _, signals in planner.chosen.values() for signal in signals}
    sources = tuple(
        SignalSource(log, topic, tuple(signals))
        for (log, _), (topic, signals) in planner.chosen.items()
    )
    missing = {
        signal: planner.missing.get(signal, "no topic of a fitting type")
        for signal in Signal
        if signal not in given
    }
    return SignalPlan(sources, missing)


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
    for section, signal in wanted:
        if section is None:
            continue
        place = planner.only(Role.CAN, section.bus or can.bus, "can.bus")
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
        # A table selected for its speed has no yaw rate.
        if planner.vehicle.can.yaw_rate is None and role_of(place[1]) is Role.ODOMETRY:
            planner.choose(place, Signal.YAW_RATE)
        return
    planner.missing[Signal.WHEEL_SPEEDS] = (
        "no wheel speeds: name the bus, DBC and signals under [can] in the vehicle file, or a "
        "topic with speeds as topics.odometry"
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
    if compass.use is False:
        planner.missing[Signal.MAGNETIC_FIELD] = "compass.use is false in the vehicle file"
        planner.missing[Signal.HEADING] = planner.missing[Signal.MAGNETIC_FIELD]
    elif names.heading is not None:
        place = planner.only(Role.IMU, names.heading, "topics.heading")
        if place is not None:
            planner.choose(place, Signal.HEADING)
    else:
        place = planner.only(Role.MAGNETOMETER, names.magnetometer, "topics.magnetometer")
        if place is not None and compass.uses_magnetometer:
            planner.choose(place, Signal.MAGNETIC_FIELD)
        elif place is not None:
            planner.missing[Signal.MAGNETIC_FIELD] = (
                f"{place[1].name} is not calibrated: run crosscue fit compass, or set compass.use "
                "= true in the vehicle file to use it as it is"
            )
    place = planner.only(Role.GNSS, names.gnss, "topics.gnss")
    if place is not None:
        planner.choose(place, Signal.COURSE)
        planner.choose(place, Signal.POSITION)


def _plan_mobileye(planner: _Planner) -> None:
    """Plan a Mobileye from the bus in the vehicle file, else from messages; it may be missing."""
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
        lacks = "mobileye.bus is not set" if bus is None else f"no topic {bus} (mobileye.bus)"
        reason = f"{lacks}, and there are no messages of mobileye_560_660_msgs"
        planner.missing.update(dict.fromkeys(MOBILEYE_SIGNALS, reason))
        return
    if len(places["ObstacleData"]) > 1:
        names = ", ".join(topic.name for _, topic in places["ObstacleData"])
        raise VehicleError(
            f"several topics could be the Mobileye's obstacles: {names}; set mobileye.bus in the "
            "vehicle file to the prefix of one device's topics"
        )
    for name, found in places.items():
        for place in found:
            lanes = name == "LkaLane"
            planner.choose(place, Signal.MOBILEYE_LANES if lanes else Signal.MOBILEYE_OBSTACLES)


def chosen_camera(
    topics: Sequence[tuple[int, Topic]], vehicle: Vehicle
) -> tuple[int, Topic] | None:
    """Return the camera that the vehicle file names, or the only one; None without a camera.

    Raises:
        VehicleError: The named topic does not exist, or there are several candidates.
    """
    return _Planner(topics, vehicle).only(Role.CAMERA, vehicle.topics.camera, "topics.camera")


def pictures_only(camera: tuple[int, Topic]) -> SignalPlan:
    """Return a plan that reads only the camera's pictures."""
    return with_pictures(SignalPlan((), {}), camera)


def with_pictures(planned: SignalPlan, camera: tuple[int, Topic]) -> SignalPlan:
    """Return the plan with the camera's pictures added; see ``Extractor.on_pictures``."""
    log, topic = camera
    return replace(planned, sources=(*planned.sources, SignalSource(log, topic, ())))
