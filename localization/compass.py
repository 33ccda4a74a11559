"""Heading from a magnetometer.

A reading is corrected for iron that turns with the car (hard iron: an offset; soft iron: a
matrix), laid into the car's axes forward, left, up, levelled where roll and pitch are known, and
the level part points to magnetic north. Heading is counter-clockwise from east; magnetic north
lies ``declination_rad`` clockwise of true north. Model: M. Caruso, "Applications of Magnetic
Sensors for Low Cost Compass Systems", IEEE PLANS 2000.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .angles import interpolate_angle, wrap_all

Vector: TypeAlias = tuple[float, float, float]
Matrix: TypeAlias = tuple[Vector, Vector, Vector]

IDENTITY: Final[Matrix] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class CompassSettings:
    """From a magnetometer's reading to a heading.

    Attributes:
        mounting_rotation: Turns the sensor's axes into forward, left, up.
        mounting_yaw_rad: By how much the sensor is turned, counter-clockwise, besides.
        hard_iron_t: Offset in the sensor's axes, in the readings' unit, taken off first.
        soft_iron: Applied, in the sensor's axes, to what then remains.
        declination_rad: Of magnetic north from the map's north, east positive.
    """

    mounting_rotation: Matrix = IDENTITY
    mounting_yaw_rad: float = 0.0
    hard_iron_t: Vector = (0.0, 0.0, 0.0)
    soft_iron: Matrix = IDENTITY
    declination_rad: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is not a rotation, a correction or a number.

        Raises:
            ValueError: Naming the field.
        """
        for f in fields(self):
            if not np.isfinite(np.array(getattr(self, f.name))).all():
                raise ValueError(f"{f.name}: expected finite numbers, got {getattr(self, f.name)}")
        turn = np.array(self.mounting_rotation)
        if turn.shape != (3, 3) or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6):
            raise ValueError(
                f"mounting_rotation: expected a rotation, got {self.mounting_rotation}"
            )
        if np.linalg.det(turn) < 0.0:
            raise ValueError(
                "mounting_rotation: expected a rotation, got a mirror; turn one axis round"
            )
        soft = np.array(self.soft_iron)
        if soft.shape != (3, 3) or not np.linalg.det(soft) > 0.0:
            raise ValueError(f"soft_iron: expected determinant > 0, got {self.soft_iron}")


def heading(
    field_t: NDArray[np.float64],
    settings: CompassSettings,
    roll_rad: NDArray[np.float64] | None = None,
    pitch_rad: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Headings of the car, counter-clockwise from east.

    Args:
        field_t: Shape (N, 3): readings in the sensor's axes; any unit that ``hard_iron_t`` shares.
        settings: The compass.
        roll_rad: Shape (N,): about forward, right side down positive; None: level.
        pitch_rad: Shape (N,): about left, nose down positive; None: level.

    Returns:
        Shape (N,), in (-pi, pi]; NaN where a reading is not finite or has no level part.

    Raises:
        ValueError: Columns do not line up.
    """
    level = level_field(field_t, settings, roll_rad, pitch_rad)
    forward, left = level[:, 0], level[:, 1]
    north_rad = np.arctan2(left, forward) + settings.mounting_yaw_rad
    found = wrap_all(math.pi / 2 - settings.declination_rad - north_rad)
    return np.where(np.hypot(forward, left) > 0.0, found, np.nan)


def level_field(
    field_t: NDArray[np.float64],
    settings: CompassSettings,
    roll_rad: NDArray[np.float64] | None = None,
    pitch_rad: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Corrected readings in level axes forward, left, up, before the mounting yaw.

    Arguments and errors as for ``heading``; shape (N, 3).
    """
    n = len(field_t)
    if field_t.shape != (n, 3):
        raise ValueError(f"field_t: expected ({n}, 3), got {field_t.shape}")
    for name, angle in (("roll_rad", roll_rad), ("pitch_rad", pitch_rad)):
        if angle is not None and angle.shape != (n,):
            raise ValueError(f"{name}: expected ({n},), got {angle.shape}")
    to_car = np.array(settings.mounting_rotation) @ np.array(settings.soft_iron)
    body: NDArray[np.float64] = (field_t - np.array(settings.hard_iron_t)) @ to_car.T
    if roll_rad is None and pitch_rad is None:
        return body
    zero = np.zeros(n)
    roll = zero if roll_rad is None else roll_rad
    pitch = zero if pitch_rad is None else pitch_rad
    forward, left, up = body.T
    left_of = np.cos(roll) * left - np.sin(roll) * up
    up_of = np.sin(roll) * left + np.cos(roll) * up
    return np.column_stack(
        [
            np.cos(pitch) * forward + np.sin(pitch) * up_of,
            left_of,
            np.cos(pitch) * up_of - np.sin(pitch) * forward,
        ]
    )


def course_at(
    at_ns: NDArray[np.int64],
    course_t_ns: NDArray[np.int64],
    course_rad: NDArray[np.float64],
    speed_mps: NDArray[np.float64],
    min_speed_mps: float = 3.0,
    max_gap_s: float = 1.5,
) -> NDArray[np.float64]:
    """The course over ground at other times, NaN where the car was too slow to have one.

    Args:
        at_ns: Shape (M,): wanted times.
        course_t_ns: Shape (N,), increasing.
        course_rad: Shape (N,): counter-clockwise from east.
        speed_mps: Shape (N,): over ground.
        min_speed_mps: Rows below are left out: their course is noise.
        max_gap_s: Rows further apart are not bridged.
    """
    usable = np.isfinite(course_rad) & (speed_mps >= min_speed_mps)
    return interpolate_angle(at_ns, course_t_ns[usable], course_rad[usable], round(max_gap_s * 1e9))
