"""Tests of dead reckoning from wheel speeds."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.localization.odometry import (
    BY_STEERING,
    BY_WHEELS,
    BY_YAW_RATE,
    OdometryCounts,
    OdometrySettings,
    Pending,
    TurnSignal,
    WheelSamples,
    first_reading,
    integrate,
)
from crosscue.replay.columns import Floats, Int64s
from support.simulated_drive import BASE_M, TRACK_M, drive, gyro, wheels

CAR = OdometrySettings(track_width_m=TRACK_M, wheelbase_m=BASE_M)


def times(n: int, period_ns: int = 20_000_000) -> Int64s:
    return np.arange(n, dtype=np.int64) * period_ns


def both_wheels(speed_mps: float, n: int = 101) -> WheelSamples:
    return WheelSamples(times(n), np.full((n, 2), speed_mps))


def on_circle(radius_m: float, speed_mps: float, n: int = 101) -> WheelSamples:
    """Four wheels rolling without slip about a point to the left of the rear axle."""
    yaw = speed_mps / radius_m
    left, right = radius_m - TRACK_M / 2, radius_m + TRACK_M / 2
    front = [math.hypot(left, BASE_M) * yaw, math.hypot(right, BASE_M) * yaw]
    return WheelSamples(times(n), np.tile([*front, left * yaw, right * yaw], (n, 1)))


@given(speed=st.floats(-20.0, 40.0), scale=st.floats(0.9, 1.1))
@settings(max_examples=30)
def test_straight_distance_is_speed_times_time_times_scale(speed: float, scale: float) -> None:
    made = integrate(both_wheels(speed), replace(CAR, wheel_scale=scale)).increments

    assert made.distance_m.sum() == pytest.approx(2.0 * speed * scale, abs=1e-9)
    assert made.turn_rad.sum() == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("use_front_wheels", [False, True])
def test_left_circle_yields_its_arc_length_and_angle(use_front_wheels: bool) -> None:
    car = replace(CAR, use_front_wheels=use_front_wheels)
    made = integrate(on_circle(8.0, 4.0), car).increments

    assert made.distance_m.sum() == pytest.approx(8.0)
    assert made.turn_rad.sum() == pytest.approx(1.0)
    assert set(made.turn_source) == {BY_WHEELS}


def test_wheels_steering_and_gyro_agree_on_a_circle() -> None:
    speeds = on_circle(12.0, 3.0)
    n = len(speeds)
    steering = TurnSignal(times(n), np.full(n, 15.0 * math.atan(BASE_M / 12.0) + 0.1), "steering")
    rate = TurnSignal(times(n), np.full(n, (3.0 / 12.0) / 0.98 + 0.03), "yaw rate")
    car = replace(
        CAR, steering_ratio=15.0, steering_offset_rad=0.1, gyro_bias_radps=0.03, yaw_rate_scale=0.98
    )
    by_wheels = integrate(speeds, car).increments
    by_steering = integrate(speeds, car, steering).increments
    by_gyro = integrate(speeds, car, rate).increments

    np.testing.assert_allclose(by_steering.turn_rad, by_wheels.turn_rad, rtol=1e-9)
    np.testing.assert_allclose(by_gyro.turn_rad, by_wheels.turn_rad, rtol=1e-9)
    assert set(by_steering.turn_source) == {BY_STEERING}
    assert set(by_gyro.turn_source) == {BY_YAW_RATE}


def test_steering_of_a_car_that_understeers_yields_its_circle_at_any_speed() -> None:
    """At the characteristic speed (20 m/s here) a turn needs twice the angle (Gillespie, 6.2)."""
    car = replace(CAR, steering_ratio=15.0, understeer_s2pm2=1.0 / 20.0**2)
    for speed in (2.0, 20.0, 30.0):
        angle = 15.0 * math.atan(BASE_M / 100.0 * (1.0 + (speed / 20.0) ** 2))
        speeds = on_circle(100.0, speed)
        steering = TurnSignal(speeds.t_ns, np.full(len(speeds), angle), "steering")
        made = integrate(speeds, car, steering).increments

        assert made.turn_rad.sum() == pytest.approx(2.0 * speed / 100.0)


def test_gyro_is_integrated_between_wheel_rows() -> None:
    """A pulse of the yaw rate between two wheel rows counts towards the turn."""
    pulse = np.zeros(11)
    pulse[5] = 1.0
    rate = TurnSignal(times(11, 10_000_000), pulse, "yaw rate")
    slow = WheelSamples(times(2, 100_000_000), np.zeros((2, 2)))

    assert integrate(slow, CAR, rate).increments.turn_rad[0] == pytest.approx(0.01)


def test_invalid_wheel_rows_are_dropped_and_counted() -> None:
    t_ns = np.array([0, 10, 10, 5, 20, 30, 40], np.int64) * 1_000_000
    speeds = np.full((7, 2), 3.0)
    speeds[4, 1] = np.nan
    speeds[5, 0] = np.inf
    made = integrate(WheelSamples(t_ns, speeds), CAR)

    assert made.counts == OdometryCounts(
        rows=7, not_finite=2, repeated=1, out_of_order=1, intervals=2
    )
    assert made.increments.start_ns.tolist() == [0, 10_000_000]
    assert made.increments.stop_ns.tolist() == [10_000_000, 40_000_000]


def test_gap_is_counted_and_raises_the_distance_variance() -> None:
    t_ns = np.array([0, 100, 200, 3_200, 3_300], np.int64) * 1_000_000
    made = integrate(WheelSamples(t_ns, np.full((5, 2), 10.0)), CAR)

    assert made.increments.is_gap.tolist() == [False, False, True, False]
    assert made.counts.gaps == 1
    assert made.increments.distance_var_m2[2] > 6.0**2
    assert made.increments.distance_var_m2[3] < 0.1**2


@pytest.mark.parametrize("kind", ["wheels", "yaw rate", "steering"])
def test_variances_do_not_depend_on_the_sampling_rate(kind: str) -> None:
    def sums(rate_hz: float) -> Floats:
        truth = drive(np.random.default_rng(4), seconds=40.0, rate_hz=rate_hz)
        speeds = wheels(truth, CAR)
        turn = None
        if kind == "yaw rate":
            turn = gyro(truth, CAR)
        elif kind == "steering":
            turn = TurnSignal(truth.t_ns, 0.3 * truth.yaw_radps, "steering")
        made = integrate(speeds, CAR, turn).increments
        return np.array([made.distance_var_m2.sum(), made.turn_var_rad2.sum()])

    np.testing.assert_allclose(sums(100.0), sums(25.0), rtol=0.01)


def test_turn_delay_shifts_the_turn_signal_back() -> None:
    at_s = times(101) * 1e-9
    late = TurnSignal(times(101) + 130_000_000, np.sin(at_s), "yaw rate")
    on_time = TurnSignal(times(101), np.sin(at_s), "yaw rate")
    car = replace(CAR, turn_delay_s=0.13)

    np.testing.assert_array_equal(
        integrate(both_wheels(5.0), car, late).increments.turn_rad,
        integrate(both_wheels(5.0), CAR, on_time).increments.turn_rad,
    )


def test_wheel_delay_shifts_wheels_and_turns_back_in_any_windows() -> None:
    late_ns = 85_000_000
    turn = TurnSignal(times(101), np.sin(times(101) * 1e-9), "yaw rate")
    speeds = both_wheels(5.0)
    car = replace(CAR, wheel_delay_s=0.085)
    on_time = integrate(speeds, CAR, turn).increments
    late = WheelSamples(speeds.t_ns + late_ns, speeds.wheels_mps)
    late_turn = replace(turn, t_ns=turn.t_ns + late_ns)

    whole = integrate(late, car, late_turn).increments
    np.testing.assert_array_equal(whole.start_ns, on_time.start_ns)
    np.testing.assert_array_equal(whole.turn_rad, on_time.turn_rad)
    assert first_reading(late, car) == first_reading(speeds, CAR)

    cut_ns = int(late.t_ns[40]) + 1
    pending, turned = Pending(), []
    for before, until_ns in ((True, cut_ns), (False, None)):
        wheel_rows = (late.t_ns < cut_ns) == before
        turn_rows = (late_turn.t_ns < cut_ns) == before
        some = WheelSamples(late.t_ns[wheel_rows], late.wheels_mps[wheel_rows])
        rates = TurnSignal(late_turn.t_ns[turn_rows], late_turn.values[turn_rows], "yaw rate")
        step = integrate(some, car, rates, pending, until_ns)
        pending = step.pending
        turned.append(step.increments.turn_rad)
    np.testing.assert_array_equal(np.concatenate(turned), on_time.turn_rad)


@pytest.mark.parametrize("angle", [0.0, 0.3, -0.5])
def test_steering_noise_scales_with_the_derivative_of_the_turn(angle: float) -> None:
    def turned(by: float) -> float:
        steering = TurnSignal(times(2), np.full(2, by), "steering")
        speeds = WheelSamples(times(2), np.full((2, 2), 10.0))
        return float(integrate(speeds, CAR, steering).increments.turn_rad[0])

    steering = TurnSignal(times(2), np.full(2, angle), "steering")
    speeds = WheelSamples(times(2), np.full((2, 2), 10.0))
    made = integrate(speeds, CAR, steering).increments
    slope = (turned(angle + 1e-6) - turned(angle - 1e-6)) / 2e-6
    density = CAR.steering_noise_rad_sqrt_m / math.sqrt(made.distance_m[0])

    assert math.sqrt(made.turn_var_rad2[0]) == pytest.approx(abs(slope) * density)


@given(
    cuts=st.lists(st.integers(-10, 2_100), max_size=5),
    turn_period=st.integers(3, 90),
    lag=st.integers(-400, 400),
    delay=st.integers(-60, 60),
)
def test_windowed_increments_are_bit_identical(
    cuts: list[int], turn_period: int, lag: int, delay: int
) -> None:
    rng = np.random.default_rng(0)
    speeds = WheelSamples(times(101), rng.normal(5.0, 1.0, (101, 2)))
    turn_t = times(2_000 // turn_period, turn_period * 1_000_000) + lag * 1_000_000
    turn = TurnSignal(turn_t, rng.normal(size=len(turn_t)), "yaw rate")
    car = replace(CAR, max_gap_s=0.08, turn_delay_s=delay * 1e-3)
    whole = integrate(speeds, car, turn)

    edges = [-(10**10), *sorted(c * 1_000_000 for c in cuts), 10**10]
    pending, counts, parts = Pending(), OdometryCounts(), []
    for low, high in pairwise(edges):
        w = slice(*np.searchsorted(speeds.t_ns, [low, high]))
        g = slice(*np.searchsorted(turn_t, [low, high]))
        made = integrate(
            WheelSamples(speeds.t_ns[w], speeds.wheels_mps[w]),
            car,
            TurnSignal(turn_t[g], turn.values[g], "yaw rate"),
            pending,
            None if high == edges[-1] else high,
        )
        pending, counts = made.pending, counts + made.counts
        parts.append(made.increments)

    for name in ("start_ns", "stop_ns", "distance_m", "turn_rad", "turn_var_rad2", "turn_source"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(joined, getattr(whole.increments, name))
    assert counts == whole.counts


def test_steering_without_a_wheelbase_is_refused() -> None:
    with pytest.raises(ValueError, match="wheelbase_m: needed for steering"):
        integrate(
            both_wheels(1.0),
            OdometrySettings(track_width_m=1.6),
            TurnSignal(times(2), np.zeros(2), "steering"),
        )
