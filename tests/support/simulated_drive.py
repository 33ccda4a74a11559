"""Simulated drives of a car with wheel sensors, gyro and compass, and their truth."""

from dataclasses import dataclass

import numpy as np

from crosscue.localization.angles import wrap_all
from crosscue.localization.odometry import OdometrySettings, TurnSignal, WheelSamples
from crosscue.localization.pose_track import Headings, PoseColumns
from crosscue.replay.columns import Floats, Int64s

TRACK_M = 1.6
BASE_M = 2.7


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """True motion of the car.

    Attributes:
        t_ns: Shape (N,).
        xyh: Shape (N, 3): position in metres, heading in radians.
        speed_mps: Shape (N,).
        yaw_radps: Shape (N,).
    """

    t_ns: Int64s
    xyh: Floats
    speed_mps: Floats
    yaw_radps: Floats


def drive(rng: np.random.Generator, seconds: float = 60.0, rate_hz: float = 20.0) -> Truth:
    """Simulate a drive with stops, reversing and turns, with circular arcs between samples."""
    n = round(seconds * rate_hz) + 1
    t_s = np.arange(n) / rate_hz
    phase = rng.uniform(0.0, 2 * np.pi, 3)
    speed = 7.0 + 9.0 * np.sin(2 * np.pi * t_s / 37.0 + phase[0])
    speed[np.abs(speed) < 1.0] = 0.0
    yaw = 0.25 * np.sin(2 * np.pi * t_s / 11.0 + phase[1]) * np.sign(speed)
    distance = 0.5 * (speed[1:] + speed[:-1]) / rate_hz
    turn = 0.5 * (yaw[1:] + yaw[:-1]) / rate_hz
    heading = phase[2] + np.concatenate([[0.0], np.cumsum(turn)])
    chord = distance * np.sinc(turn / 2 / np.pi)
    middle = heading[:-1] + turn / 2
    xy = np.cumsum(np.column_stack([chord * np.cos(middle), chord * np.sin(middle)]), axis=0)
    xyh = np.column_stack([np.vstack([[0.0, 0.0], xy]), wrap_all(heading)])
    t_ns = np.round(t_s * 1e9).astype(np.int64) + 1_533_000_000_000_000_000
    return Truth(t_ns, xyh, speed, yaw)


def wheels(
    truth: Truth, settings: OdometrySettings, rng: np.random.Generator | None = None
) -> WheelSamples:
    """Rear wheel speeds, with slip and rounding of the settings; exact without ``rng``."""
    speed = truth.speed_mps.copy()
    if rng is not None:
        dt_s = np.median(np.diff(truth.t_ns)) * 1e-9
        slip = settings.slip_per_sqrt_m * np.sqrt(np.abs(speed) / dt_s)
        speed += rng.normal(0.0, 1.0, len(speed)) * slip
    half = 0.5 * truth.yaw_radps * settings.track_width_m
    both = np.column_stack([speed - half, speed + half])
    if rng is not None and settings.wheel_step_mps:
        both = np.round(both / settings.wheel_step_mps) * settings.wheel_step_mps
    return WheelSamples(truth.t_ns, both)


def gyro(
    truth: Truth, settings: OdometrySettings, rng: np.random.Generator | None = None
) -> TurnSignal:
    """Yaw rate with the noise density of the settings; exact without ``rng``."""
    values = truth.yaw_radps.copy()
    if rng is not None:
        dt_s = np.median(np.diff(truth.t_ns)) * 1e-9
        density = settings.gyro_noise_rad_per_sqrt_s
        values += rng.normal(0.0, 1.0, len(values)) * density / np.sqrt(dt_s)
    return TurnSignal(truth.t_ns, values, "yaw rate")


def compass(
    truth: Truth, sd_rad: float, rng: np.random.Generator, every: int = 2, persists_s: float = 0.0
) -> Headings:
    """Headings at every ``every``-th sample, with white or AR(1) errors (``persists_s``)."""
    t_ns = truth.t_ns[1::every]
    error = rng.normal(0.0, sd_rad, len(t_ns))
    if persists_s > 0.0:
        kept = np.exp(-np.diff(t_ns) * 1e-9 / persists_s)
        for i, fraction in enumerate(kept, start=1):
            error[i] = fraction * error[i - 1] + np.sqrt(1.0 - fraction**2) * error[i]
    heading = wrap_all(truth.xyh[1::every, 2] + error)
    return Headings(t_ns, heading, np.full(len(t_ns), sd_rad**2))


def nees_of(poses: PoseColumns, truth: Truth, row: int) -> float:
    """Normalised squared error of one pose, with three degrees of freedom."""
    estimate = np.array([poses.x_m[row], poses.y_m[row], poses.heading_rad[row]])
    error = estimate - truth.xyh[np.searchsorted(truth.t_ns, poses.t_ns[row])]
    error[2] = wrap_all(error[2:])[0]
    xx, xy, xh, yy, yh, hh = poses.cov_xyh[row]
    cov = np.array([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]])
    return float(error @ np.linalg.solve(cov, error))
