"""Simulate a drive without pictures: a car in town, its CAN, gyro, magnetometer and true pose.

Everything is generated from a seed. Sensor errors are of the kinds that the pose filter models
(quantized wheel speeds, slip, gyro bias and noise), and of one kind that it does not (magnetic
disturbance that varies along the road). The demo therefore does not score the filter on its own
model.
"""

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Final

import numpy as np
from numpy.random import Generator

from crosscue.replay.columns import ColumnSet, Floats, Int64s
from crosscue.replay.files.tree_text import toml_document

WHEELBASE_M: Final = 2.7
TRACK_WIDTH_M: Final = 1.55
STEERING_RATIO: Final = 15.0
# Horizontal (towards magnetic north) and vertical (up) part of the Earth's field.
FIELD_T: Final = np.array([20e-6, -43e-6])
# Files next to the log of a drive; some drives have fewer.
FILES_OF_DRIVE: Final = ("vehicle.toml", "truth.json", "pose.tum", "objects.json", "ranges.csv")
START_NS: Final = 1_700_000_000_000_000_000
RATE_HZ: Final = 100
# Relative standard deviation of a tyre's radius, which is constant during a drive.
TYRE_SD: Final = 0.003
# Relative standard deviation of a wheel's speed, with a correlation time of ``SLIP_TIME_S``.
SLIP_SD: Final = 0.004
SLIP_TIME_S: Final = 2.0
# Standard deviation of a reading, without the bias.
GYRO_SD_RADPS: Final = 0.004
START_SD_M: Final = 0.1
# Standard deviation of a calibrated car's heading at the start of the drive.
START_HEADING_SD_RAD: Final = 0.01


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """Settings of a simulated drive.

    Attributes:
        seed: Seed of all random numbers.
        blocks: Number of street blocks.
        block_m: Length of a block.
        top_speed_mps: Max speed between turns.
        declination_rad: Magnetic declination, east of north.
        mounting_yaw_rad: Yaw of the magnetometer in the car.
        gyro_bias_radps: Constant error of the gyro.
    """

    seed: int = 7
    blocks: int = 12
    block_m: float = 120.0
    top_speed_mps: float = 12.0
    declination_rad: float = 0.23
    mounting_yaw_rad: float = 0.1
    gyro_bias_radps: float = 0.002


@dataclass(frozen=True, slots=True, eq=False)
class TrueMotion(ColumnSet):
    """Motion of the car's rear axle at 100 Hz.

    Attributes:
        t_ns: Times, shape (N,), int64.
        x_m: East, shape (N,).
        y_m: North, shape (N,).
        heading_rad: Heading, counter-clockwise from east, not wrapped, shape (N,).
        speed_mps: Speed, shape (N,).
        yaw_rate_radps: Yaw rate, shape (N,).
    """

    t_ns: Int64s
    x_m: Floats
    y_m: Floats
    heading_rad: Floats
    speed_mps: Floats
    yaw_rate_radps: Floats


def true_motion(settings: DriveSettings) -> TrueMotion:
    """Return the true motion of the car."""
    rng = np.random.default_rng([settings.seed, 1])
    curvature, limit_mps = _road(settings, rng)
    speed = _speed_along(limit_mps, settings.top_speed_mps)
    step_s = 1.0 / RATE_HZ
    at_m, along, speeds = 0.0, [], []
    v = 0.5
    while at_m < len(curvature) - 1:
        target = float(speed[int(at_m)])
        v += float(np.clip(target - v, -2.5 * step_s, 1.8 * step_s))
        at_m += v * step_s
        along.append(at_m)
        speeds.append(v)
    bend = np.interp(np.array(along), np.arange(len(curvature)), _smoothed(curvature))
    return integrated(bend, np.array(speeds), heading_rad=0.3)


def integrated(
    curvature: Floats,
    speed_mps: Floats,
    x_m: float = 0.0,
    y_m: float = 0.0,
    heading_rad: float = 0.0,
) -> TrueMotion:
    """Return the motion along a path, from curvature and speed at each step and the start."""
    step_s = 1.0 / RATE_HZ
    yaw_rate = curvature * speed_mps
    turned = np.cumsum(yaw_rate * step_s)
    heading = np.concatenate(([heading_rad], heading_rad + turned))[:-1]
    middle = heading + yaw_rate * step_s / 2
    x = x_m + np.concatenate(([0.0], np.cumsum(speed_mps * step_s * np.cos(middle))))[:-1]
    y = y_m + np.concatenate(([0.0], np.cumsum(speed_mps * step_s * np.sin(middle))))[:-1]
    t_ns = START_NS + np.arange(len(x), dtype=np.int64) * (1_000_000_000 // RATE_HZ)
    return TrueMotion(t_ns, x, y, heading, speed_mps, yaw_rate)


def _road(settings: DriveSettings, rng: Generator) -> tuple[Floats, Floats]:
    pieces: list[Floats] = []
    limits: list[Floats] = []
    radius_m = 9.0
    for _ in range(settings.blocks):
        straight = np.zeros(round(settings.block_m))
        turn = int(rng.choice([-1, 0, 1], p=[0.3, 0.4, 0.3]))
        corner = np.full(round(radius_m * np.pi / 2) if turn else 8, turn / radius_m)
        pieces += [straight, corner]
        slow = 4.5 if turn else settings.top_speed_mps
        limits += [np.full(len(straight), settings.top_speed_mps), np.full(len(corner), slow)]
    pieces.append(np.zeros(40))
    limits.append(np.full(40, 1.0))
    return np.concatenate(pieces), np.concatenate(limits)


def _smoothed(curvature: Floats) -> Floats:
    # Steering takes time: smoothing over five metres preserves the angle of each turn.
    kernel = np.hanning(7)[1:-1]
    return np.convolve(curvature, kernel / kernel.sum(), mode="same")


def _speed_along(limit_mps: Floats, top_mps: float) -> Floats:
    """Return the max speed at each metre that allows braking in time (2 m/s2)."""
    speed = np.minimum(limit_mps, top_mps)
    for i in range(len(speed) - 2, -1, -1):
        speed[i] = min(speed[i], np.sqrt(speed[i + 1] ** 2 + 2 * 2.0))
    return speed


@dataclass(frozen=True, slots=True, eq=False)
class Sensed:
    """Readings of the car's sensors.

    Attributes:
        wheel_t_ns: Times of wheel speeds and steering, shape (W,), 50 Hz.
        wheels_mps: Speeds front left, front right, rear left, rear right, shape (W, 4).
        steering_rad: Angle of the steering wheel, positive to the left, shape (W,).
        gyro_t_ns: Times of the gyro, shape (G,), 100 Hz.
        gyro_radps: Rates about forward, left, up, shape (G, 3).
        mag_t_ns: Times of the magnetometer, shape (M,), 10 Hz.
        mag_t: Field in tesla in the sensor's axes, shape (M, 3).
    """

    wheel_t_ns: Int64s
    wheels_mps: Floats
    steering_rad: Floats
    gyro_t_ns: Int64s
    gyro_radps: Floats
    mag_t_ns: Int64s
    mag_t: Floats


def sense(motion: TrueMotion, settings: DriveSettings) -> Sensed:
    """Return simulated readings for ``motion``."""
    rng = np.random.default_rng([settings.seed, 2])
    half = slice(None, None, 2)
    v, w = motion.speed_mps[half], motion.yaw_rate_radps[half]
    side = np.array([-1.0, 1.0]) * TRACK_WIDTH_M / 2
    rear = v[:, None] + w[:, None] * side
    front = np.hypot(rear, (w * WHEELBASE_M)[:, None])
    true_wheels = np.concatenate([front, rear], axis=1)
    tyre = 1.0 + rng.normal(0.0, TYRE_SD, 4)
    slip = _wander(rng, len(v), 4, rate_hz=RATE_HZ / 2, time_s=SLIP_TIME_S) * SLIP_SD
    wheels = true_wheels * tyre * (1.0 + slip) + rng.normal(0.0, 0.02, true_wheels.shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        road_wheel = np.where(v > 0.1, np.arctan(WHEELBASE_M * w / np.maximum(v, 0.1)), 0.0)
    gyro = rng.normal(0.0, GYRO_SD_RADPS, (len(motion), 3))
    gyro[:, 2] += motion.yaw_rate_radps + settings.gyro_bias_radps
    tenth = slice(None, None, 10)
    return Sensed(
        motion.t_ns[half],
        wheels,
        road_wheel * STEERING_RATIO + rng.normal(0.0, 0.01, len(v)),
        motion.t_ns,
        gyro,
        motion.t_ns[tenth],
        _magnetometer(motion.heading_rad[tenth], settings, rng),
    )


def with_simulated_noise(text: str, settings: DriveSettings, motion: TrueMotion) -> str:
    """Return a vehicle file's text with the true noise of these readings, for a meaningful NEES.

    The file is that of a newly calibrated car. It contains the gyro's bias, and the start of the
    drive with an error of the specified standard deviation.
    """
    import tomlkit  # it is slow to import

    east_m, north_m, off = np.random.default_rng([settings.seed, 11]).normal(0.0, 1.0, 3)
    way_m = float(np.hypot(np.diff(motion.x_m), np.diff(motion.y_m)).sum())
    document = toml_document(text)
    document["odometry"].update(
        slip_per_sqrt_m=round(slip_per_sqrt_m(way_m, float(motion.speed_mps.max())), 4),
        scale_sd=round(TYRE_SD / 2**0.5, 4),
        gyro_bias_radps=settings.gyro_bias_radps,
        gyro_noise_rad_per_sqrt_s=GYRO_SD_RADPS / RATE_HZ**0.5,
    )
    start = document["start"]
    start.update(
        x_m=round(START_SD_M * float(east_m), 4),
        y_m=round(START_SD_M * float(north_m), 4),
        position_sd_m=START_SD_M,
        heading_rad=round(float(start["heading_rad"]) + START_HEADING_SD_RAD * float(off), 6),
        heading_sd_rad=START_HEADING_SD_RAD,
    )
    return tomlkit.dumps(document)


def slip_per_sqrt_m(way_m: float, speed_mps: float) -> float:
    """Return the vehicle file's slip for the rear wheels' simulated errors over a drive.

    The error of a wrong radius grows with the distance, that of correlated slip with its square
    root. A single parameter can match both at one length only.
    """
    radius = TYRE_SD**2 / 2.0 * way_m
    slip = SLIP_SD**2 / 2.0 * 2.0 * SLIP_TIME_S * speed_mps
    return float(np.sqrt(radius + slip))


def _magnetometer(heading_rad: Floats, settings: DriveSettings, rng: Generator) -> Floats:
    # Angle of magnetic north from the sensor's forward axis.
    north = np.pi / 2 - settings.declination_rad - heading_rad - settings.mounting_yaw_rad
    disturbed = north + _wander(rng, len(north), 1, rate_hz=10.0, time_s=4.0)[:, 0] * np.deg2rad(8)
    level = FIELD_T[0] * np.stack([np.cos(disturbed), np.sin(disturbed)], axis=1)
    field = np.concatenate([level, np.full((len(north), 1), FIELD_T[1])], axis=1)
    return field + rng.normal(0.0, 0.3e-6, field.shape)


def _wander(rng: Generator, n: int, k: int, *, rate_hz: float, time_s: float) -> Floats:
    """Return first-order Gauss-Markov noise with unit variance, shape (n, k)."""
    keep = float(np.exp(-1.0 / (rate_hz * time_s)))
    kicks = rng.normal(0.0, 1.0, (n, k))
    kicks[1:] *= np.sqrt(1.0 - keep * keep)
    out = np.empty((n, k))
    state = np.zeros(k)
    for i in range(n):
        state = keep * state + kicks[i]
        out[i] = state
    return out


def dbc_path() -> Path:
    """Return the path of the DBC file of the simulated car's bus."""
    return Path(str(files("crosscue.datasets.simulated").joinpath("simulated_car.dbc")))


# Sections of the simulated cars' vehicle files that are equal in all of them.
HEAD: Final = """\
version = 1
name = "crosscue simulated car"
"""
CAN: Final = """
[can]
bus = "{bus}"
dbc = ["{dbc}"]

[can.wheel_speeds]
front_left = "WHEEL_SPEEDS.FRONT_LEFT"
front_right = "WHEEL_SPEEDS.FRONT_RIGHT"
rear_left = "WHEEL_SPEEDS.REAR_LEFT"
rear_right = "WHEEL_SPEEDS.REAR_RIGHT"
"""
MOTION: Final = """
[odometry]
wheelbase_m = 2.7
track_width_m = 1.55

[compass]
mounting_yaw_rad = {mounting_yaw_rad}
declination_rad = {declination_rad}
heading_sd_rad = 0.16
interval_s = 8.0

[start]
heading_rad = {heading_rad}
heading_sd_rad = 0.05
"""


def vehicle_text(settings: DriveSettings, dbc: str) -> str:
    """Return the text of the simulated car's vehicle file."""
    return f"# The simulated car of crosscue's demo.\n{HEAD}{CAN}{MOTION}".format(
        bus="/can",
        dbc=dbc,
        mounting_yaw_rad=settings.mounting_yaw_rad,
        declination_rad=settings.declination_rad,
        heading_rad=0.3,
    )
