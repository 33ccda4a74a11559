"""The vehicle file's sections for the pose: odometry, GNSS and the start of a drive."""

import math
from itertools import product
from typing import Final, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from .section import Finite, NotNegative, Positive, Section

GnssUse: TypeAlias = Literal["start", "truth", "fuse", "off"]
DEGREE: Final = math.pi / 180.0


class OdometryFitted(Section):
    """Record of a fit of the odometry, written by ``crosscue fit odometry`` for information only.

    RMS errors are those of the position from odometry alone, from the start of the fitted span.
    """

    log: str
    """Name of the log."""
    reference: str
    """Source of the reference positions."""
    start_ns: int
    """Start of the fitted span on the log's clock; the end is exclusive."""
    end_ns: int
    positions: int
    outliers: int
    """Number of positions with a larger error than one correct position in a thousand."""
    position_sd_m: NotNegative
    """Standard deviation of the reference positions, estimated from the residuals."""
    rms_m: NotNegative
    """RMS error over the fitted span."""
    held_out_rms_m: NotNegative
    """RMS error over the rest of the log, which was not fitted."""
    held_out_before_rms_m: NotNegative
    """RMS error over the rest of the log with the values before the fit."""
    sd: dict[str, NotNegative] = Field(default_factory=dict)
    """Standard deviation of each fitted value."""
    not_observable: tuple[str, ...] = ()
    """Parameters that the span does not determine; they keep their values."""


ConstantName: TypeAlias = Literal[
    "wheel_scale",
    "gyro_bias_radps",
    "yaw_rate_scale",
    "steering_ratio",
    "steering_offset_rad",
    "understeer_s2pm2",
    "wheelbase_m",
    "right_wheel_scale",
    "track_width_m",
    "wheel_delay_s",
]


class OdometryConstants(Section):
    """Values of ``[odometry]`` whose errors are states of the pose filter: constant, or drifting.

    ``crosscue fit odometry`` writes this section.
    """

    names: tuple[ConstantName, ...]
    """Names of the values; each is in ``[odometry]``."""
    covariance: tuple[tuple[Finite, ...], ...]
    """Covariance of their errors, one row per name."""
    drift_per_sqrt_s: dict[ConstantName, NotNegative] = Field(default_factory=dict)
    """Standard deviation of a value's change in one second, as a random walk; by default 0."""

    @model_validator(mode="after")
    def _is_covariance(self) -> Self:
        cov, k = self.covariance, len(self.names)
        if len(cov) != k or any(len(row) != k for row in cov):
            raise ValueError(f"covariance: expected {k} rows of {k} numbers, one for each name")
        for i, j in product(range(k), range(k)):
            limit = math.sqrt(max(cov[i][i], 0.0) * max(cov[j][j], 0.0)) * 1.000001
            if cov[i][j] != cov[j][i] or abs(cov[i][j]) > limit:
                both = f"{self.names[i]} and {self.names[j]}"
                raise ValueError(f"covariance of {both}: {cov[i][j]:g}, not that of any errors")
        return self


class Odometry(Section):
    """Wheels, gyro and steering, as defined in ``crosscue.localization.odometry``.

    ``crosscue fit odometry`` writes this section.
    """

    kind: Literal["auto", "wheels", "visual"] = "auto"
    """Source of the speed. ``wheels``: wheel speeds, or a topic with the car's speed. ``visual``:
    the pictures, by ``camera.focal_px`` and ``camera.z_m``. ``auto``: the pictures only where no
    log has a speed."""

    track_width_m: Positive = 1.55
    wheelbase_m: Positive = 2.7
    wheel_scale: Positive = 1.0
    right_wheel_scale: Positive = 1.0
    front_left_scale: Positive | None = None
    """Further scale of the front left wheel; by default that of the rear wheel on its side. Only
    ``use_front_wheels`` uses the front wheels."""
    front_right_scale: Positive | None = None
    use_front_wheels: bool = False
    wheel_step_mps: NotNegative = 0.0028
    slip_per_sqrt_m: NotNegative = 0.3
    """Growth of the distance error. The default covers a wheel radius error of 1 %, as on an
    uncalibrated vehicle: 10 m per km."""
    scale_sd: NotNegative = 0.01
    """The same error as a fraction of the distance, for ranges from motion. Over their baseline of
    about 20 m, ``slip_per_sqrt_m`` would overestimate it by a factor of seven."""
    heading_from: Literal["auto", "yaw_rate", "steering", "wheels"] = "auto"
    """Source of the heading change; ``auto`` selects the first of the other three in the log."""
    yaw_rate_scale: Positive = 1.0
    gyro_bias_radps: Finite = 0.0
    gyro_noise_rad_per_sqrt_s: NotNegative = 0.005
    """Growth of the heading error. The default covers a residual bias of 0.0006 rad/s: 2 degrees in
    a minute."""
    steering_ratio: Positive = 15.0
    steering_offset_rad: Finite = 0.0
    understeer_s2pm2: Finite = 0.0
    """Growth of the steering angle for the same turn with the square of the speed, typically 0.001
    to 0.003 s2/m2; by default 0, as published."""
    steering_noise_rad_sqrt_m: NotNegative = 0.01
    wheel_turn_rad_per_sqrt_m: NotNegative = 0.03
    """Growth of the heading error with ``heading_from = "wheels"``. The default covers tyres that
    differ by 0.3 %: 0.2 rad in 100 m."""
    turn_per_turn: NotNegative = 0.0
    turn_rad_per_sqrt_rad: NotNegative = 0.0
    """Standard deviation of the heading after a turn of one radian."""
    wheel_delay_s: NotNegative = 0.0
    """Delay of the time stamps of wheel speeds, yaw rate and steering relative to the positions."""
    turn_delay_s: Finite = 0.0
    """Delay of the time stamps of yaw rate or steering relative to those of the wheel speeds."""
    max_gap_s: Positive = 0.5
    accel_var_m2ps3: NotNegative = 1.0
    constants: OdometryConstants | None = None
    """Constant errors of the values above. By default there are none, as published."""
    fitted: OdometryFitted | None = None


class Gnss(Section):
    """A GNSS receiver and its antenna."""

    use: GnssUse = "start"
    """``start``: the first seconds determine the start position and, unless ``start.heading_rad``
    is set, the heading. ``truth``: GNSS is used only by ``crosscue truth from-gnss``. ``fuse``: as
    ``start``, and positions also update the pose. The published method never does this, and GNSS
    is then no independent truth. ``off``: GNSS is ignored."""
    x_m: Finite = 0.0
    """Distance of the antenna ahead of the rear axle."""
    y_m: Finite = 0.0
    position_sd_m: Positive = 3.0
    """Standard deviation of east and north, where the receiver reports none."""
    course_sd_rad: Positive = 3.0 * DEGREE
    """Standard deviation of the course over ground at ``min_speed_mps`` or more."""
    min_speed_mps: Positive = 3.0
    """Minimum speed at which the course over ground is used; below, it is noise."""
    delay_s: Finite = 0.0
    """Delay of the time stamps of positions and courses."""
    interval_s: NotNegative = 1.0
    """With ``fuse``: minimum time between two updates, because a receiver's errors persist."""
    gate_nis: Positive = 13.8
    """With ``fuse``: positions with a larger normalised innovation squared are rejected (one
    correct position in a thousand exceeds the default)."""


class Start(Section):
    """The pose at the log's first row, in the map frame (x east, y north)."""

    x_m: Finite = 0.0
    y_m: Finite = 0.0
    position_sd_m: Positive = 1.0
    heading_rad: Finite | None = None
    """Heading; by default estimated from the first compass readings."""
    heading_sd_rad: Positive = 5.0 * DEGREE
    map_origin: tuple[Finite, Finite, Finite] | None = None
    """Latitude and longitude in degrees and altitude in metres of the map's origin, if known."""
    source: str = ""
    """Source of this pose; a run that finds it in the log records it here."""
