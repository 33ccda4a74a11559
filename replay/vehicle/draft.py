"""A first vehicle file from what a log and its DBC files hold, each guess with its reason."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from crosscue.replay.base import CanFrames, EmptyResultError, Ledger, Log, Selection
from crosscue.replay.decode import decoder_for
from crosscue.replay.losses import warn_of
from crosscue.replay.remote.logs import name_of
from crosscue.replay.signals.converters import ANGLE_UNITS, SPEED_UNITS

from .draft_camera import AFTER_CAMERA, camera_lines
from .roles import Role, role_of

if TYPE_CHECKING:
    from crosscue.replay.can.database import CanDatabase
    from crosscue.replay.can.layout import CanMessage, CanSignal

REQUESTS: Final = frozenset(
    {"REQ", "REQUEST", "REQUESTED", "CMD", "COMMAND", "TARGET", "DES", "DESIRED", "SETPOINT", "SP"}
)
"""Words in the name of a signal that asks for something and measures nothing."""
FRAMES_LOOKED_AT: Final = 50_000
WHEELS: Final = {
    "front_left": ("FL", "LF", "FRONTLEFT", "LEFTFRONT"),
    "front_right": ("FR", "RF", "FRONTRIGHT", "RIGHTFRONT"),
    "rear_left": ("RL", "LR", "REARLEFT", "LEFTREAR"),
    "rear_right": ("RR", "REARRIGHT", "RIGHTREAR"),
}
DEVICES: Final = (
    (Role.CAMERA, "camera"),
    (Role.IMU, "imu"),
    (Role.MAGNETOMETER, "magnetometer"),
    (Role.GNSS, "gnss"),
    (Role.ODOMETRY, "odometry"),
)


@dataclass(frozen=True, slots=True)
class Bus:
    """One CAN bus of the log.

    Attributes:
        topic: Its name.
        ids: Identifiers seen at its beginning, each with whether it is extended.
        known: How many of them the database holds.
    """

    topic: str
    ids: frozenset[tuple[int, bool]]
    known: int


def draft(logs: Sequence[Log], dbc: Sequence[Path], folder: Path) -> str:
    """The text of a first vehicle file.

    Args:
        logs: Open logs of one drive.
        dbc: Files that describe its buses.
        folder: Where the file will lie; DBC paths are written relative to it where possible.

    Raises:
        EmptyResultError: No topic of the logs plays any role.
        SchemaError: A DBC file cannot be read.
    """
    topics = [topic for log in logs for topic in log.topics]
    if all(role_of(topic) is None for topic in topics):
        names = ", ".join(f"{topic.name} ({topic.type_name})" for topic in topics) or "none"
        raise EmptyResultError(
            f"{', '.join(map(name_of, logs))}: no topic plays a role in a vehicle file; there are: "
            f"{names}; give a log with a CAN bus, camera, compass or inertial unit"
        )
    lines = [
        "# A first vehicle file, made from what the log holds. Check every line against the car:",
        "# what could not be seen in the log stands here as a comment or with its default.",
        "version = 1",
        'name = "unnamed"',
        "",
        *_topic_lines(logs),
    ]
    database = None
    if dbc:
        from crosscue.replay.can.database import CanDatabase

        database = CanDatabase.load(list(dbc))
    lines += _can_lines(_buses(logs, database), database, dbc, folder)
    lines += [
        "[odometry]",
        "# Measure these on the car:",
        "# wheelbase_m = 2.7",
        "# track_width_m = 1.55",
        "",
        "# [compass] is written by: crosscue fit compass LOG --vehicle THIS_FILE",
        "",
        *camera_lines(logs),
    ]
    return "\n".join(lines).rstrip("\n") + "\n\n" + AFTER_CAMERA


def _topic_lines(logs: Sequence[Log]) -> Iterator[str]:
    topics = [topic for log in logs for topic in log.topics]
    chosen: list[str] = []
    for role, key in DEVICES:
        names = [topic.name for topic in topics if role_of(topic) is role]
        if len(names) > 1:
            chosen.append(f"{key} = {_quoted(names[0])}  # or: {', '.join(names[1:])}")
        elif names:
            chosen.append(f"# {key} = {_quoted(names[0])}  # found without naming it")
    if chosen:
        yield from ("[topics]", *chosen, "")


def _buses(logs: Sequence[Log], database: CanDatabase | None) -> list[Bus]:
    buses = []
    for log in logs:
        for topic in log.topics:
            if role_of(topic) is not Role.CAN:
                continue
            ledger = Ledger(name_of(log))
            ids = frozenset(_ids(log, topic.name, ledger))
            warn_of(ledger)
            known = sum(database is not None and database.find(*key) is not None for key in ids)
            buses.append(Bus(topic.name, ids, known))
    return sorted(buses, key=lambda bus: (-bus.known, bus.topic))


def _ids(log: Log, name: str, ledger: Ledger) -> Iterator[tuple[int, bool]]:
    """Identifiers among a bus's first frames."""
    seen = 0
    topic = next(topic for topic in log.topics if topic.name == name)
    decode = decoder_for(topic) if topic.encoding != "columns" else None
    for block in log.read(ledger, Selection(frozenset({name}))):
        rows = (decode(block, ledger) if decode else block).rows
        if isinstance(rows, CanFrames):
            keys = rows.arbitration_id.astype(np.int64) | rows.is_extended.astype(np.int64) << 32
            for key in np.unique(keys).tolist():
                yield key & 0xFFFF_FFFF, bool(key >> 32)
        seen += len(block)
        if seen > FRAMES_LOOKED_AT:
            return


def _can_lines(
    buses: Sequence[Bus], database: CanDatabase | None, dbc: Sequence[Path], folder: Path
) -> Iterator[str]:
    if not buses:
        yield from ("# The log has no CAN bus.", "")
        return
    best = buses[0]
    yield "[can]"
    if len(buses) > 1:
        others = ", ".join(bus.topic for bus in buses[1:])
        yield f"bus = {_quoted(best.topic)}  # or: {others}"
    if database is None:
        yield from ("# dbc = [...]  # give the files with --dbc to have signals looked up", "")
        return
    yield f"dbc = [{', '.join(_quoted(_relative(path, folder)) for path in dbc)}]"
    yield f"# {best.known} of the {len(best.ids)} identifiers on {best.topic} are in the DBC files."
    yield ""
    messages = [database.find(*key) for key in sorted(best.ids)]
    yield from _signal_lines([message for message in messages if message is not None])


def _signal_lines(messages: Sequence[CanMessage]) -> Iterator[str]:
    wheels = {wheel: _wheel_candidates(messages, tokens) for wheel, tokens in WHEELS.items()}
    if wheels["rear_left"] and wheels["rear_right"]:
        yield "[can.wheel_speeds]"
        for wheel, names in wheels.items():
            if names:
                others = f"  # or: {', '.join(names[1:])}" if len(names) > 1 else ""
                yield f"{wheel} = {_quoted(names[0])}{others}"
        yield "# wheel_radius_m = 0.32  # needed where the signals are in rad/s"
    else:
        yield "# No signal looks like a wheel speed; name them under [can.wheel_speeds]."
    yield ""
    for key, words in (("yaw_rate", ("YAW",)), ("steering", ("STEER", "ANGLE"))):
        names = [
            f"{message.name}.{signal.name}"
            for message in messages
            for signal in message.signals
            if all(word in signal.name.upper() for word in words)
            and not _is_request(message, signal)
            and signal.unit.strip().lower() in ANGLE_UNITS
        ]
        if names:
            yield f"# [can.{key}]  # check the sign: counter-clockwise must be positive"
            yield f"# signal = {_quoted(names[0])}"
            yield ""


def _wheel_candidates(messages: Sequence[CanMessage], tokens: Sequence[str]) -> list[str]:
    found = [
        (("WHEEL" not in message.name.upper() and "WH" not in signal.name.upper()), message, signal)
        for message in messages
        for signal in message.signals
        if _is_speed(signal)
        and _has_token(signal.name, tokens)
        and not _is_request(message, signal)
    ]
    found.sort(key=lambda item: item[0])
    return [f"{message.name}.{signal.name}" for _, message, signal in found]


def _is_request(message: CanMessage, signal: CanSignal) -> bool:
    return any(not REQUESTS.isdisjoint(_words(name)) for name in (message.name, signal.name))


def _is_speed(signal: CanSignal) -> bool:
    unit = signal.unit.strip().lower()
    return signal.length >= 8 and (unit in SPEED_UNITS or unit == "rad/s")


def _has_token(name: str, tokens: Sequence[str]) -> bool:
    upper = _words(name)
    pairs = [a + b for a, b in pairwise(upper)]
    return any(token in upper or token in pairs for token in tokens)


def _words(name: str) -> list[str]:
    """Of a name in capitals, in camel case or with underscores."""
    return [word.upper() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in escaped) + '"'


def _relative(path: Path, folder: Path) -> str:
    try:
        return str(path.resolve().relative_to(folder.resolve()))
    except ValueError:
        return str(path.resolve())
