"""The vehicle file's sections that the pose comes from: odometry, GNSS and where a drive begins."""

from __future__ import annotations

import math
from typing import Final, Literal, TypeAlias

from pydantic import Field

from .section import Finite, NotNegative, Positive, Section

GnssUse: TypeAlias = Literal["start", "truth", "fuse", "off"]
DEGREE: Final = math.pi / 180.0


class OdometryFitted(Section):
    """Where fitted odometry comes from; ``crosscue fit odometry`` writes it, nothing else reads it.

    Root mean squares are of the position by odometry alone, from the start of the fitted span.
    """

    log: str
    """Name of the log."""
    reference: str
    """What the positions came from."""
    start_ns: int
    """The fitted span, on the log's clock; half open."""
    end_ns: int
    positions: int
    outliers: int
    """Of those, further off than one good position in a thousand is."""
    position_sd_m: NotNegative
    """Of the positions, by the residuals."""
    rms_m: NotNegative
    """Over the fitted span."""
    held_out_rms_m: NotNegative
    """Over the rest of the log, which was not fitted."""
    held_out_before_rms_m: NotNegative
    """The same with the values that were there before."""
    sd: dict[str, NotNegative] = Field(default_factory=dict)
    """Of each fitted value."""
    not_observable: tuple[str, ...] = ()
    """What the span did not show; left as it was."""


class Odometry(Section):
    """Wheels, gyro and steering; the terms are those of ``crosscue.localization.odometry``.

    ``crosscue fit odometry`` writes it.
    """

    track_width_m: Positive = 1.55
    wheelbase_m: Positive = 2.7
    wheel_scale: Positive = 1.0
    right_wheel_scale: Positive = 1.0
    use_front_wheels: bool = False
    wheel_step_mps: NotNegative = 0.0028
    slip_per_sqrt_m: NotNegative = 0.3
    """The default covers a wheel radius that is off by 1 %, as on an uncalibrated car: 10 m per
    km."""
    scale_sd: NotNegative = 0.01
    """The same as what it is, a fraction of every distance: over the 20 m by which a range comes
    from motion, ``slip_per_sqrt_m`` would be seven times too much."""
    heading_from: Literal["auto", "yaw_rate", "steering", "wheels"] = "auto"
    """Which signal turns the pose; ``auto`` takes the first of these three that the log has."""
    yaw_rate_scale: Positive = 1.0
    gyro_bias_radps: Finite = 0.0
    gyro_noise_rad_per_sqrt_s: NotNegative = 0.005
    """The default covers a bias of 0.0006 rad/s that was not removed: 2 degrees in a minute."""
    steering_ratio: Positive = 15.0
    steering_offset_rad: Finite = 0.0
    steering_noise_rad_sqrt_m: NotNegative = 0.01
    wheel_turn_rad_per_sqrt_m: NotNegative = 0.03
    """The default covers tyres that differ by 0.3 %: 0.2 rad in 100 m, where wheels turn the
    pose."""
    turn_per_turn: NotNegative = 0.0
    turn_rad_per_sqrt_rad: NotNegative = 0.0
    """S.d. of the heading after one radian of turning."""
    turn_delay_s: Finite = 0.0
    """How long after the wheel speeds' the stamps of yaw rate or steering come."""
    max_gap_s: Positive = 0.5
    accel_var_m2ps3: NotNegative = 1.0
    fitted: OdometryFitted | None = None


class Gnss(Section):
    """A GNSS receiver and its antenna."""

    use: GnssUse = "start"
    """``start``: its first seconds say where the drive begins and which way the car faces, unless
    ``start.heading_rad`` does. ``truth``: it is kept for ``crosscue truth from-gnss`` alone.
    ``fuse``: as ``start``, and positions are weighed into the pose, which the published method
    never does; GNSS is then no independent truth. ``off``: nothing."""
    x_m: Finite = 0.0
    """The antenna, ahead of the rear axle."""
    y_m: Finite = 0.0
    position_sd_m: Positive = 3.0
    """S.d. of east and of north, where the receiver states none."""
    course_sd_rad: Positive = 3.0 * DEGREE
    """S.d. of the course over ground, from ``min_speed_mps`` on."""
    min_speed_mps: Positive = 3.0
    """Below, the course is noise."""
    delay_s: Finite = 0.0
    """How long after they were true positions and courses are stamped."""
    interval_s: NotNegative = 1.0
    """With ``fuse``, time between two positions that count: a receiver's errors last."""
    gate_nis: Positive = 13.8
    """With ``fuse``, refuse a position farther off, as one good position in a thousand is."""


class Start(Section):
    """The pose at the log's first row, in the map frame (x east, y north)."""

    x_m: Finite = 0.0
    y_m: Finite = 0.0
    position_sd_m: Positive = 1.0
    heading_rad: Finite | None = None
    """Left out: taken from the first compass readings."""
    heading_sd_rad: Positive = 5.0 * DEGREE
    map_origin: tuple[Finite, Finite, Finite] | None = None
    """Latitude and longitude in degrees and altitude in metres of the map's zero, where known."""
    source: str = ""
    """Where this pose comes from; a run that found it in the log records it here."""
