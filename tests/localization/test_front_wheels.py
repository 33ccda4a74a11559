"""Tests of the fit of each front wheel's scale to the motion of the rear axle."""

from dataclasses import replace

import numpy as np

from crosscue.localization.fit.front_wheels import front_wheels
from crosscue.localization.odometry import OdometrySettings, WheelSamples, integrate
from support.simulated_drive import BASE_M, TRACK_M, Truth, drive, gyro, wheels

FRONT = {"front_left_scale": 1.008, "front_right_scale": 0.991}
CAR = OdometrySettings(
    track_width_m=TRACK_M, wheelbase_m=BASE_M, slip_per_sqrt_m=0.005, gyro_noise_rad_per_sqrt_s=1e-3
)
REAR_SCALES = replace(CAR, wheel_scale=1.02, right_wheel_scale=0.995)
FOUR_SCALES = replace(
    REAR_SCALES,
    front_left_scale=FRONT["front_left_scale"],
    front_right_scale=FRONT["front_right_scale"],
)


def four_wheels(truth: Truth, rng: np.random.Generator) -> WheelSamples:
    """Simulate the speeds reported by wheels with the scales of ``FOUR_SCALES``."""
    rear = wheels(truth, CAR, rng).wheels_mps
    across = BASE_M * truth.yaw_radps[:, None]
    front = np.sign(rear) * np.hypot(rear, across)
    scales = FOUR_SCALES.wheel_scales
    return WheelSamples(truth.t_ns, np.hstack([front, rear]) / scales)


def test_distinct_scales_of_four_wheels_are_recovered() -> None:
    rng = np.random.default_rng(seed=3)
    truth = drive(rng, seconds=300.0)
    car, settings = four_wheels(truth, rng), REAR_SCALES
    made = integrate(car, settings, gyro(truth, CAR, rng)).increments

    found = front_wheels(car, made, settings, (int(truth.t_ns[0]), int(truth.t_ns[-1])))

    assert [one.setting for one in found] == [*FRONT]
    for one in found:
        off = one.scale - FRONT[one.setting]
        assert abs(off) < 4.0 * one.sd
        assert one.sd < 0.5 * abs(FRONT[one.setting] - 1.0)


def test_equal_front_and_rear_speeds_yield_no_front_scales() -> None:
    truth = drive(np.random.default_rng(seed=7))
    rear = wheels(truth, CAR).wheels_mps
    car = WheelSamples(truth.t_ns, np.hstack([rear, rear]))
    made = integrate(car, CAR).increments

    assert front_wheels(car, made, CAR, (int(truth.t_ns[0]), int(truth.t_ns[-1]))) == ()
