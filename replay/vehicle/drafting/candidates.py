"""Candidate signals of a CAN database for wheel speed, yaw rate and steering angle.

Candidates are proposed by name and unit. Their readings decide which are used (``agreement``).
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from crosscue.replay.signals.converters import ANGLE_UNITS, SPEED_UNITS

if TYPE_CHECKING:
    from crosscue.replay.can.layout import CanMessage, CanSignal

# Words in the names of requests, which are not measurements.
REQUESTS: Final = frozenset(
    {"REQ", "REQUEST", "REQUESTED", "RQ", "RQST", "CMD", "COMMAND", "COMMANDED", "TARGET", "TGT"}
    | {"DES", "DESIRED", "DSRD", "DEMAND", "DMD", "SETPOINT", "SETPT", "SP", "SET", "SOLL"}
    | {"WANTED", "LIMIT", "LIM", "LKA", "LKAS"}
)
# Words in the names of signals about other objects or about another signal.
OTHERS: Final = frozenset({"TRAILER", "TRLR", "OFFSET", "OFFST", "ACCURACY", "LEAD"})
# Words that identify a wheel; the last ones of each wheel are German.
WHEELS: Final = {
    "front_left": ("FL", "LF", "FRONTLEFT", "LEFTFRONT", "VL"),
    "front_right": ("FR", "RF", "FRONTRIGHT", "RIGHTFRONT", "VR"),
    "rear_left": ("RL", "LR", "REARLEFT", "LEFTREAR", "HL"),
    "rear_right": ("RR", "REARRIGHT", "RIGHTREAR", "HR"),
}
OF_WHEELS: Final = ("WHEEL", "WHL", "WH", "RAD", "RADGESCHW")
OF_SPEED: Final = ("SPEED", "SPD", "VELOCITY", "VEL", "GESCHW", "V")
OF_YAW: Final = ("YAW", "GIER", "GIERRATE", "YR")
OF_STEERING: Final = (
    "STEER",
    "STEERING",
    "STE",
    "STR",
    "SAS",
    "LENKRADWINKEL",
    "LENKWINKEL",
    "LWI",
)
OF_GNSS: Final = ("GPS", "GNSS")


class SignalKind(Enum):
    """The possible meaning of a signal."""

    WHEEL = "wheel speed"
    SPEED = "speed of the car"
    GNSS_SPEED = "speed from GNSS"
    YAW_RATE = "yaw rate"
    STEERING = "steering angle"


@dataclass(frozen=True, slots=True)
class Candidate:
    """A signal that may be an input of odometry.

    Attributes:
        message: Message name in the database, with its identifier if the name is ambiguous.
        signal: Signal name in the database.
        kind: Possible meaning.
        unit: Unit in the database; empty if unspecified.
        scale: Factor from its unit to SI; 1 for a wheel in rad/s, whose radius is unknown.
        wheel: Key of ``WHEELS``; empty for other kinds.
        stem: Name without the words that identify the wheel, equal for wheels that belong together.
    """

    message: str
    signal: str
    kind: SignalKind
    unit: str
    scale: float
    wheel: str = ""
    stem: str = ""

    @property
    def name(self) -> str:
        """Name in a vehicle file."""
        return f"{self.message}.{self.signal}"

    @property
    def is_turning(self) -> bool:
        """True for a wheel's angular rate, whose conversion to a speed needs a radius."""
        return self.kind is SignalKind.WHEEL and _unit(self.unit) in _TURNING


_TURNING: Final = frozenset({"rad/s", "radians/second", "rad/sec"})


def candidates(messages: Sequence[CanMessage]) -> Iterator[Candidate]:
    """Yield the candidate signals by name and unit, without requests."""
    for message in messages:
        for signal in message.signals:
            found = _candidate(message, signal)
            if found is not None:
                yield found


def _candidate(message: CanMessage, signal: CanSignal) -> Candidate | None:
    of_signal, of_message = _words(signal.name), _words(message.name)
    both = {*of_signal, *of_message}
    if signal.length < 8 or not REQUESTS.isdisjoint(both) or not OTHERS.isdisjoint(both):
        return None
    unit = _unit(signal.unit)
    wheel = next((w for w, words in WHEELS.items() if _has_word(of_signal, words)), "")
    is_turning, is_speed = unit in _TURNING, unit in SPEED_UNITS
    is_rate = unit.endswith(("/s", "/sec", "/second", "persecon"))
    stem = ""
    if wheel and (is_speed or is_turning) and (not is_turning or _mentions(both, OF_WHEELS)):
        kind, scale = SignalKind.WHEEL, 1.0 if is_turning else SPEED_UNITS[unit]
        stem = "_".join([message.topic_name, *_without(of_signal, WHEELS[wheel])])
    elif is_speed and _mentions(both, OF_SPEED):
        kind = SignalKind.GNSS_SPEED if _mentions(both, OF_GNSS) else SignalKind.SPEED
        scale = SPEED_UNITS[unit]
    elif unit in ANGLE_UNITS and is_rate and _mentions(of_signal, OF_YAW):
        kind, scale = SignalKind.YAW_RATE, ANGLE_UNITS[unit]
    elif (
        unit in ANGLE_UNITS
        and not is_rate
        and _mentions(both, OF_STEERING)
        and not _mentions(of_signal, OF_YAW)
    ):
        kind, scale = SignalKind.STEERING, ANGLE_UNITS[unit]
    else:
        return None
    of_wheel = wheel if kind is SignalKind.WHEEL else ""
    return Candidate(message.topic_name, signal.name, kind, signal.unit, scale, of_wheel, stem)


def _unit(text: str) -> str:
    return text.strip().lower()


def _mentions(words: Collection[str], wanted: Sequence[str]) -> bool:
    """Return whether a word equals one of these, or begins with a longer one of them."""
    return any(
        word == one or (len(one) > 3 and word.startswith(one)) for word in words for one in wanted
    )


def _has_word(words: Sequence[str], wanted: Sequence[str]) -> bool:
    pairs = [a + b for a, b in pairwise(words)]
    return any(word in words or word in pairs for word in wanted)


def _without(words: Sequence[str], those: Sequence[str]) -> list[str]:
    parts = {*those, "FRONT", "REAR", "LEFT", "RIGHT"}
    return [word for word in words if word not in parts]


def _words(name: str) -> list[str]:
    """Split a name in capitals, in camel case or with underscores into words."""
    return [word.upper() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]
