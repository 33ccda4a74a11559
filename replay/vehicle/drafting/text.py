"""The text of a drafted vehicle file, with the reason for each choice in a comment."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crosscue.replay.base import Log, name_of
from crosscue.replay.errors import EmptyResultError, SchemaError
from crosscue.replay.files.tree_text import spelled
from crosscue.replay.vehicle.roles import Role, role_of

from .agreement import SignalVerdict
from .camera import AFTER_CAMERA, CameraMounting, camera_lines
from .candidates import WHEELS
from .choice import Choices, ChosenSignal, rank_candidates
from .observed import Bus, Observed, observe

if TYPE_CHECKING:
    from crosscue.replay.can.database import CanDatabase

DEVICES: Final = (
    (Role.CAMERA, "camera"),
    (Role.IMU, "imu"),
    (Role.MAGNETOMETER, "magnetometer"),
    (Role.GNSS, "gnss"),
    (Role.ODOMETRY, "odometry"),
)
# Maximum number of rejected signals that are listed with their reasons.
LISTED: Final = 6


@dataclass(frozen=True, slots=True, eq=False)
class Examined:
    """A drive's logs with the signals found in them.

    Attributes:
        logs: Open logs.
        databases: Paths of the files that describe the buses.
        database: The combined database; None without files.
        seen: Observed buses and motion.
        choices: The chosen signals.
        left_out: Files that contradict the others, each with the contradiction.
    """

    logs: Sequence[Log]
    databases: Sequence[Path]
    database: CanDatabase | None
    seen: Observed
    choices: Choices
    left_out: Sequence[tuple[Path, str]] = ()


def examine(logs: Sequence[Log], dbc: Sequence[Path]) -> Examined:
    """Read the first minutes of a drive and choose its signals.

    Args:
        logs: Open logs of one drive.
        dbc: Files that describe its buses.

    Raises:
        EmptyResultError: No topic of the logs has a role, or none is a CAN bus for the files.
        SchemaError: A DBC file cannot be read.
    """
    topics = [topic for log in logs for topic in log.topics]
    names = ", ".join(f"{topic.name} ({topic.type_name})" for topic in topics) or "none"
    roles = {role_of(topic) for topic in topics}
    if not roles - {None}:
        raise EmptyResultError(
            f"{', '.join(map(name_of, logs))}: no topic has a role in a vehicle file; there are: "
            f"{names}; expected a log with a CAN bus, camera, compass or inertial unit"
        )
    if dbc and Role.CAN not in roles:
        raise EmptyResultError(
            f"{', '.join(map(name_of, logs))}: no CAN bus for {', '.join(one.name for one in dbc)};"
            f" there are: {names}; expected messages of can_msgs/msg/Frame, or a CAN log beside it"
        )
    if not dbc:
        seen = observe(logs, None)
        return Examined(logs, (), None, seen, rank_candidates(seen))
    kept, database, left_out = _agreeing(logs, dbc)
    seen = observe(logs, database)
    return Examined(logs, kept, database, seen, rank_candidates(seen), left_out)


def _agreeing(
    logs: Sequence[Log], dbc: Sequence[Path]
) -> tuple[Sequence[Path], CanDatabase, Sequence[tuple[Path, str]]]:
    """Return the consistent files, their combined database, and the other files with the reason.

    Each bus of a car has its own files, and two files may use the same identifier for different
    messages. Files with wheel speeds take precedence, then files that describe most messages of a
    bus.

    Raises:
        SchemaError: A single file cannot be read, or contradicts itself.
    """
    from crosscue.replay.can.database import CanDatabase

    try:
        return dbc, CanDatabase.load(list(dbc)), ()
    except SchemaError:
        if len(dbc) == 1:
            raise
    seen = {path: observe(logs, CanDatabase.load([path])) for path in dbc}

    def worth(path: Path) -> tuple[bool, int]:
        has_wheels = any(
            one.has_axle and not one.verdict.wrong for one in rank_candidates(seen[path]).wheels
        )
        return has_wheels, max((bus.known for bus in seen[path].buses), default=0)

    kept: list[Path] = []
    left_out: list[tuple[Path, str]] = []
    for path in sorted(dbc, key=worth, reverse=True):
        try:
            CanDatabase.load([*kept, path])
            kept.append(path)
        except SchemaError as error:
            left_out.append((path, str(error).partition(", with different signals")[0]))
    return kept, CanDatabase.load(kept), left_out


def draft_text(examined: Examined, folder: Path, mounting: CameraMounting) -> str:
    """Return the text of a drafted vehicle file.

    Args:
        examined: The logs and the signals found in them.
        folder: Folder of the file; DBC paths are written relative to it where possible.
        mounting: Mounting of the camera, where known.
    """
    logs, choices, buses = examined.logs, examined.choices, examined.seen.buses
    lines = [
        "# A draft of a vehicle file, generated from the log. Check every line against the car.",
        "# Settings that the log does not determine are comments or have their defaults.",
        "# To see it on an image: crosscue check THIS_FILE LOG -o check.html",
        "version = 1",
        'name = "unnamed"',
        "",
        *_topic_lines(logs, choices),
        *_can_lines(examined, folder),
        "[odometry]",
        "# Measure these on the car, or: crosscue fit odometry LOG --vehicle THIS_FILE",
        "# wheelbase_m = 2.7",
        "# track_width_m = 1.55",
        "",
        "# [compass] is written by: crosscue fit compass LOG --vehicle THIS_FILE",
        "",
        *_mobileye_lines(logs, buses),
        *camera_lines(logs, mounting),
    ]
    return "\n".join(lines).rstrip("\n") + "\n\n" + AFTER_CAMERA


def _topic_lines(logs: Sequence[Log], choices: Choices) -> Iterator[str]:
    topics = [topic for log in logs for topic in log.topics]
    chosen: list[str] = []
    for role, key in DEVICES:
        names = [topic.name for topic in topics if role_of(topic) is role]
        if len(names) > 1:
            chosen.append(f"{key} = {_quoted(names[0])}  # or: {', '.join(names[1:])}")
        elif names:
            chosen.append(f"# {key} = {_quoted(names[0])}  # found automatically")
        if role is Role.IMU:
            units = [one for one in choices.yaw_rates if one.name in names]
            chosen += [
                line for one in units for line in _comment(f"{one.name}: {_as_text(one.verdict)}")
            ]
    chosen += _speed_lines(choices.tables)
    if chosen:
        yield from ("[topics]", *chosen, "")


def _speed_lines(tables: Sequence[ChosenSignal]) -> Iterator[str]:
    """Yield the topic with the car's speed, which has no role until the vehicle file names it."""
    sound = [one for one in tables if not one.verdict.wrong]
    if sound:
        others = f"  # or: {', '.join(one.name for one in sound[1:])}" if sound[1:] else ""
        yield from _comment(f"The vehicle speed, of no axle: {_as_text(sound[0].verdict)}")
        yield f"odometry = {_quoted(sound[0].name)}{others}"
    yield from _not_chosen((one.name, one.bus, one.verdict) for one in tables if one not in sound)


def _can_lines(examined: Examined, folder: Path) -> Iterator[str]:
    buses, choices, database = examined.seen.buses, examined.choices, examined.database
    if not buses:
        yield from ("# The log has no CAN bus.", "")
        return
    # The bus of the wheels, else the one with most known messages.
    is_of_wheels = bool(choices.wheels) and choices.is_chosen(choices.wheels[0])
    main = choices.wheels[0].bus if is_of_wheels else buses[0].topic
    yield "[can]"
    if len(buses) > 1:
        yield f"bus = {_quoted(main)}"
    for bus in buses:
        of_it = f", {bus.known} of them in the DBC files" if database is not None else ""
        is_mobileye = "; a Mobileye's" if bus.mobileye else ""
        yield f"# {bus.topic}: {len(bus.ids)} identifiers{of_it}{is_mobileye}"
    if database is None:
        yield from ("# dbc = [...]  # pass the files with --dbc to search them for signals", "")
        return
    yield f"dbc = [{', '.join(_quoted(_relative(path, folder)) for path in examined.databases)}]"
    for path, why in examined.left_out:
        yield from _comment(f"omitted, a file of another bus: {path.name}: {why}")
    yield ""
    yield from _wheel_lines(choices, main)
    yield from _angle_lines("yaw_rate", choices.yaw_rates, main)
    yield from _angle_lines("steering", choices.steering, main)


def _wheel_lines(choices: Choices, main: str) -> Iterator[str]:
    best = next((one for one in choices.wheels if one.has_axle), None)
    if best is None or best.verdict.wrong:
        yield from _without_wheels(choices)
    else:
        is_sure = best.verdict.is_judged
        yield "[can.wheel_speeds]"
        yield from _comment(_as_text(best.verdict))
        if not is_sure:
            yield "# Chosen only by name and unit: nothing in the log confirms the speed."
        if best.bus != main:
            yield f"bus = {_quoted(best.bus)}"
        for wheel in WHEELS:
            if wheel in best.wheels:
                yield f"{wheel} = {_quoted(best.wheels[wheel].name)}"
        if best.is_turning and best.radius_m is not None:
            yield f"wheel_radius_m = {best.radius_m:.3f}  # fits {choices.reference}"
        elif best.is_turning:
            yield "# wheel_radius_m = 0.32  # needed, as the signals are in rad/s: measure it"
    yield from _not_chosen(
        (", ".join(one.name for one in other.wheels.values()), other.bus, other.verdict)
        for other in choices.wheels
        if other is not best or other.verdict.wrong
    )
    yield ""


def _without_wheels(choices: Choices) -> Iterator[str]:
    speed = next((one for one in choices.speeds if not one.verdict.wrong), None)
    yield "# No signal seems to be a wheel speed; name the signals under [can.wheel_speeds]."
    if speed is None:
        return
    yield from _comment(f"The vehicle speed instead, of no axle: {_as_text(speed.verdict)}")
    yield "# [can.wheel_speeds]"
    if speed.bus:
        yield f"# bus = {_quoted(speed.bus)}"
    yield f"# rear_left = {_quoted(speed.name)}"
    yield f"# rear_right = {_quoted(speed.name)}"


def _angle_lines(key: str, found: Sequence[ChosenSignal], main: str) -> Iterator[str]:
    """Yield the section of the best signal, unless an inertial unit's topic is better."""
    if not any(one.bus for one in found):
        return
    best = found[0]
    if best.verdict.wrong:
        yield f"# [can.{key}]: no signal that agrees with the others."
    elif not best.bus:
        yield from _comment(f"[can.{key}]: omitted, {best.name} agrees better, see [topics]")
    else:
        is_shown = best.verdict.agrees_with > 0
        mark = "" if is_shown else "# "
        if not is_shown:
            yield "# The drive is too straight to show its sign; positive is counter-clockwise."
        yield f"{mark}[can.{key}]"
        yield from _comment(_as_text(best.verdict))
        if best.bus != main:
            yield f"{mark}bus = {_quoted(best.bus)}"
        yield f"{mark}signal = {_quoted(best.name)}"
        if is_shown:
            yield f"sign = {best.verdict.sign}"
    yield from _not_chosen(
        (one.name, one.bus, one.verdict) for one in found if one is not best or one.verdict.wrong
    )
    yield ""


def _not_chosen(others: Iterator[tuple[str, str, SignalVerdict]]) -> Iterator[str]:
    for number, (name, bus, verdict) in enumerate(others):
        if number == LISTED:
            yield "# and more"
            return
        where = f" on {bus}" if bus else ""
        yield from _comment(f"not chosen: {name}{where}: {_as_text(verdict)}")


def _comment(text: str) -> Iterator[str]:
    """Wrap a text into comment lines."""
    yield from textwrap.wrap(
        text,
        99,
        initial_indent="# ",
        subsequent_indent="#   ",
        break_long_words=False,
        break_on_hyphens=False,
    )


def _as_text(verdict: SignalVerdict) -> str:
    """Describe a verdict in one line."""
    wrong = f"WRONG: {', '.join(verdict.wrong)}; " if verdict.wrong else ""
    return wrong + ", ".join(verdict.facts)


def _mobileye_lines(logs: Sequence[Log], buses: Sequence[Bus]) -> Iterator[str]:
    topics = [topic.name for log in logs for topic in log.topics if role_of(topic) is Role.MOBILEYE]
    on_bus = [bus for bus in buses if bus.mobileye]
    if on_bus:
        yield "[mobileye]"
        for bus in on_bus[1:]:
            yield f"# or: {bus.topic}"
        yield f"bus = {_quoted(on_bus[0].topic)}  # sends: {', '.join(on_bus[0].mobileye)}"
    elif topics:
        yield f"# [mobileye]  # its messages are found automatically: {', '.join(topics[:4])}"
    else:
        yield "# [mobileye]  # none of the buses is a Mobileye's"
        yield '# bus = ""'
    yield "# x_m = 0.0  # ahead of the rear axle: measure it"
    yield ""


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'


def _relative(path: Path, folder: Path) -> str:
    try:
        return spelled(str(path.resolve().relative_to(folder.resolve())))
    except ValueError:
        return spelled(str(path.resolve()))
