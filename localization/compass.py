"""Heading from a magnetometer.

A reading is corrected for iron that turns with the car (hard iron: an offset; soft iron: a
matrix) and rotated into the car's axes forward, left, up; the car counts as level. Its horizontal
part points to magnetic north. Heading is counter-clockwise from east; magnetic north is
``declination_rad`` clockwise of true north. Model: M. Caruso, "Applications of Magnetic Sensors for
Low Cost Compass Systems", IEEE PLANS 2000.
"""

import math
from dataclasses import dataclass, fields
from typing import Final, TypeAlias

import numpy as np

from crosscue.replay.columns import Floats, Int64s

from .angles import interpolate_angle, wrap_all

Vector: TypeAlias = tuple[float, float, float]
Matrix: TypeAlias = tuple[Vector, Vector, Vector]

IDENTITY: Final[Matrix] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class CompassSettings:
    """Mounting and calibration of a magnetometer.

    Attributes:
        mounting_rotation: Rotation from the sensor's axes to forward, left, up.
        mounting_yaw_rad: Additional rotation of the sensor, counter-clockwise.
        hard_iron_t: Offset in the sensor's axes, in the readings' unit, subtracted first.
        soft_iron: Matrix that is then applied, in the sensor's axes.
        declination_rad: Angle of magnetic north from the map's north, positive to the east.
    """

    mounting_rotation: Matrix = IDENTITY
    mounting_yaw_rad: float = 0.0
    hard_iron_t: Vector = (0.0, 0.0, 0.0)
    soft_iron: Matrix = IDENTITY
    declination_rad: float = 0.0

    def __post_init__(self) -> None:
        """Validate the settings.

        Raises:
            ValueError: A field is not finite, not a rotation or not a valid correction.
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
                "mounting_rotation: expected a rotation, got a reflection; reverse one axis"
            )
        soft = np.array(self.soft_iron)
        if soft.shape != (3, 3) or not np.linalg.det(soft) > 0.0:
            raise ValueError(f"soft_iron: expected determinant > 0, got {self.soft_iron}")


def heading(field_t: Floats, settings: CompassSettings) -> Floats:
    """Compute headings of the car, counter-clockwise from east.

    Args:
        field_t: Shape (N, 3): readings in the sensor's axes, in the unit of ``hard_iron_t``.
        settings: Mounting and calibration of the compass.

    Returns:
        Shape (N,), in (-pi, pi]; NaN where a reading is not finite or has no horizontal part.

    Raises:
        ValueError: The readings have another shape.
    """
    level = level_field(field_t, settings)
    forward, left = level[:, 0], level[:, 1]
    north_rad = np.arctan2(left, forward) + settings.mounting_yaw_rad
    found = wrap_all(math.pi / 2 - settings.declination_rad - north_rad)
    return np.where(np.hypot(forward, left) > 0.0, found, np.nan)


def level_field(field_t: Floats, settings: CompassSettings) -> Floats:
    """Correct readings and rotate them to the axes forward, left, up, without the mounting yaw.

    Arguments and errors are those of ``heading``; the result has shape (N, 3).
    """
    n = len(field_t)
    if field_t.shape != (n, 3):
        raise ValueError(f"field_t: expected ({n}, 3), got {field_t.shape}")
    to_car = np.array(settings.mounting_rotation) @ np.array(settings.soft_iron)
    body: Floats = (field_t - np.array(settings.hard_iron_t)) @ to_car.T
    return body


def course_at(
    at_ns: Int64s,
    course_t_ns: Int64s,
    course_rad: Floats,
    speed_mps: Floats,
    min_speed_mps: float = 3.0,
    max_gap_s: float = 1.5,
) -> Floats:
    """Interpolate the course over ground at other times; NaN where the car was too slow.

    Args:
        at_ns: Shape (M,): requested times.
        course_t_ns: Shape (N,), increasing.
        course_rad: Shape (N,): counter-clockwise from east.
        speed_mps: Shape (N,): speed over ground.
        min_speed_mps: Speed below which rows are left out, because their course is noise.
        max_gap_s: Maximum distance of rows to interpolate between.
    """
    usable = np.isfinite(course_rad) & (speed_mps >= min_speed_mps)
    return interpolate_angle(at_ns, course_t_ns[usable], course_rad[usable], round(max_gap_s * 1e9))
