"""Motion by pictures whose stamps are late, and the signals of the same drive."""

import numpy as np

from crosscue.localization.camera_delay import PictureMotion
from crosscue.replay.columns import Floats, Int64s

RATE_HZ = 10.0


def ns(seconds: Floats) -> Int64s:
    """Seconds as integer nanoseconds."""
    return np.round(seconds * 1e9).astype(np.int64)


def turn_rad(seconds: Floats) -> Floats:
    """Heading of a car that turns at a crossing, and then changes a lane."""
    first = 1.5 / (1.0 + np.exp(-(seconds - 12.0) / 1.2))
    lane = 0.05 * np.exp(-(((seconds - 24.0) / 1.5) ** 2))
    return np.asarray(first + lane, np.float64)


def travelled_m(seconds: Floats) -> Floats:
    """Distance of a car that brakes to a stop at 10 s and moves off at 14 s."""
    grid = np.linspace(-5.0, 65.0, 14_001)
    speed = np.clip(np.maximum(2.0 * (10.0 - grid), 1.5 * (grid - 14.0)), 0.0, 10.0)
    steps = 0.5 * (speed[1:] + speed[:-1]) * np.diff(grid)
    return np.asarray(np.interp(seconds, grid, np.concatenate([[0.0], np.cumsum(steps)])))


def pictures(
    seed: int, delay_s: float, *, drift_ppm: float = 0.0, noise: float = 1.0, length_s: float = 30.0
) -> PictureMotion:
    """Motion by pictures whose stamps are late; errors as on the real drives."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, length_s, 1.0 / RATE_HZ) + rng.uniform(0.0, 0.1)
    late_s = delay_s + drift_ppm * 1e-6 * (t_s - 0.5 * length_s)
    turned = np.diff(turn_rad(t_s)) * 1.03
    slow = np.convolve(rng.normal(size=len(turned) + 9), np.ones(10) / 10.0**0.5, "valid")
    turned += noise * (np.radians(0.01) * rng.normal(size=len(turned)) + np.radians(0.003) * slow)
    moved = np.diff(travelled_m(t_s))
    scene = 0.02 * np.exp(0.1 * slow * noise)
    grown = scene * moved + noise * 2e-4 * rng.normal(size=len(moved))
    stamps = ns(t_s + late_s)
    return PictureMotion(stamps[:-1], stamps[1:], turned, grown, moved < 1e-3)


def yaw_rate(seed: int, rate_hz: float = 100.0, length_s: float = 30.0) -> tuple[Int64s, Floats]:
    """Readings of a gyro with noise and bias."""
    rng = np.random.default_rng(seed + 1000)
    t_s = np.arange(-1.5, length_s + 1.5, 1.0 / rate_hz)
    rate = np.gradient(turn_rad(t_s), t_s) + 0.003
    return ns(t_s), rate + np.radians(0.1) * rng.normal(size=len(t_s))


def speed(seed: int) -> tuple[Int64s, Floats]:
    """Readings of a speed with noise."""
    rng = np.random.default_rng(seed + 2000)
    t_s = np.arange(-1.5, 31.5, 0.02)
    return ns(t_s), np.gradient(travelled_m(t_s), t_s) + 0.03 * rng.normal(size=len(t_s))
