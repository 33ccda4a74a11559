"""Tests of the pose filter, and comparison with filterpy."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.localization.angles import wrap, wrap_all
from crosscue.localization.ekf import (
    MotionNoise,
    PoseBelief,
    bicycle,
    coast,
    is_lost,
    major_axis_m,
    predict_ekf,
    predict_odometry,
    predict_yaw_rate,
    turning,
    update_heading,
    update_position,
    update_speed,
)
from crosscue.localization.pose_filter import arc
from crosscue.replay.columns import Floats

NOISE = MotionNoise(
    wheelbase_m=2.7, accel_mps2=0.3, steering_rad=0.02, yaw_rate_radps=0.01, slip_per_sqrt_m=0.05
)
HEADINGS = st.floats(-math.pi, math.pi)
SPEEDS = st.floats(-15.0, 40.0)
STEERINGS = st.floats(-0.6, 0.6)


def belief(
    x: float = 3.0, y: float = -2.0, heading: float = 0.4, speed: float = 8.0, seed: int = 1
) -> PoseBelief:
    root = np.random.default_rng(seed).normal(size=(4, 4)) * [[1.0], [1.0], [0.05], [0.5]]
    return PoseBelief(1_000, np.array([x, y, heading, speed]), root @ root.T)


def central_differences(function: Callable[[Floats], Floats], at: Floats) -> Floats:
    """Compute a Jacobian by central differences, with wrapped angles."""
    columns = []
    for i in range(len(at)):
        step = np.zeros(len(at))
        step[i] = 1e-5
        rise = function(at + step) - function(at - step)
        rise[2] = wrap(rise[2])
        columns.append(rise / 2e-5)
    return np.column_stack(columns)


def test_prediction_along_a_quarter_circle_matches_geometry() -> None:
    radius_m = 10.0
    start = PoseBelief(0, np.array([0.0, 0.0, 0.0, 5.0]), np.zeros((4, 4)))
    dt_s = radius_m * math.pi / 2 / 5.0
    after = predict_ekf(start, 0.0, 2.7 / radius_m, dt_s, MotionNoise(wheelbase_m=2.7))

    np.testing.assert_allclose(after.mean, [10.0, 10.0, math.pi / 2, 5.0], atol=1e-12)
    assert after.t_ns == round(dt_s * 1e9)


QUARTER = math.pi / 2
# Heading north at 4 m/s. With 2 m/s2 over 0.5 s, the arc is 4 / 2 + 2 / 8 = 2.25 m long.
START = np.array([2.0, -1.0, QUARTER, 4.0])
RISE = 1.0 - 2.0 / math.pi


def test_eq_5_and_6_and_their_derivatives_over_a_quarter_turn() -> None:
    """A quarter turn of 2.25 m has a radius of 4.5 / pi: that far north, and as far west.

    With l = 2.5 and a curvature of pi / 4.5, the steering is pi / 1.8. A longer arc continues
    westwards, so d by v is (-0.5, 0), and its turn is pi / 9; by a it is a quarter of that, and the
    speed gains 0.5. Steering by 1 turns by 2.25 / 2.5 = 0.9, which moves the end of the arc by
    2.25 * 0.9 * (-4 / pi^2) forwards and by 2.25 * 0.9 * (2 / pi) (1 - 2 / pi) to the left.
    """
    motion = bicycle(START, 2.0, math.pi / 1.8, 0.5, 2.5)

    radius_m = 4.5 / math.pi
    ahead, left = -8.1 / math.pi**2, 4.05 / math.pi * RISE
    expected = [2.0 - radius_m, -1.0 + radius_m, math.pi, 5.0]
    np.testing.assert_allclose(motion.mean, expected, atol=1e-12)
    by_state = np.eye(4)
    by_state[:3, 3] = -0.5, 0.0, math.pi / 9
    by_state[:2, 2] = -radius_m, -radius_m
    np.testing.assert_allclose(motion.by_state, by_state, atol=1e-12)
    by_input = [[-0.125, -left], [0.0, ahead], [math.pi / 36, 0.9], [0.5, 0.0]]
    np.testing.assert_allclose(motion.by_input, by_input, atol=1e-12)


def test_arc_by_yaw_rate_and_its_derivatives_over_a_quarter_turn() -> None:
    """The same arc at pi rad/s; a longer arc turns by as much, so it grows in proportion.

    By v, that is 0.5 * 2 / pi to the north and to the west, and by a, a quarter of it. The yaw rate
    turns by 0.5 per rad/s.
    """
    motion = turning(START, 2.0, math.pi, 0.5)

    radius_m, grows = 4.5 / math.pi, 1.0 / math.pi
    expected = [2.0 - radius_m, -1.0 + radius_m, math.pi, 5.0]
    np.testing.assert_allclose(motion.mean, expected, atol=1e-12)
    by_state = np.eye(4)
    by_state[:2, 3] = -grows, grows
    by_state[:2, 2] = -radius_m, -radius_m
    np.testing.assert_allclose(motion.by_state, by_state, atol=1e-12)
    ahead, left = -4.5 / math.pi**2, 2.25 / math.pi * RISE
    by_input = [[-grows / 4, -left], [grows / 4, ahead], [0.0, 0.5], [0.5, 0.0]]
    np.testing.assert_allclose(motion.by_input, by_input, atol=1e-12)


def test_odometry_adds_its_variances_along_and_across() -> None:
    """2 m straight with 0.1 m2 and 0.2 rad2: half the distance levers the turn, 1 m * 0.2.

    The speed keeps its mean, and its variance grows by 0.3 * 2 s.
    """
    start = PoseBelief(5, np.array([1.0, 1.0, 0.0, 3.0]), np.zeros((4, 4)))

    after = predict_odometry(start, 2.0, 0.0, 0.1, 0.2, 2.0, 0.3)

    assert after.t_ns == 2_000_000_005
    assert after.mean.tolist() == [3.0, 1.0, 0.0, 3.0]
    cov = [[0.1, 0, 0, 0], [0, 0.2, 0.2, 0], [0, 0.2, 0.2, 0], [0, 0, 0, 0.6]]
    np.testing.assert_allclose(after.cov, cov, atol=1e-15)


def test_coast_integrates_white_noise_of_acceleration_and_yaw_rate() -> None:
    """2 s at 3 m/s. Acceleration of 0.3: t^3 / 3 = 8/3, t^2 / 2 = 2 and t = 2 times 0.3.

    Yaw rate of 0.5, levered by 6 m: 2 * 36 / 3 = 24, 2 * 6 / 2 = 6 and 2 times 0.5.
    """
    start = PoseBelief(5, np.array([1.0, 1.0, 0.0, 3.0]), np.zeros((4, 4)))

    after = coast(start, 2.0, 0.3, 0.5)

    assert after.t_ns == 2_000_000_005
    assert after.mean.tolist() == [7.0, 1.0, 0.0, 3.0]
    cov = [[0.8, 0, 0, 0.6], [0, 12.0, 3.0, 0], [0, 3.0, 1.0, 0], [0.6, 0, 0, 0.6]]
    np.testing.assert_allclose(after.cov, cov, atol=1e-12)
    assert not coast(start, 2.0, 0.0, 0.0).cov.any()


@pytest.mark.parametrize("is_position", [False, True])
@pytest.mark.parametrize("gate_nis", [None, 4.0, 3.999])
def test_gate_accepts_up_to_its_normalised_innovation_squared(
    gate_nis: float | None, is_position: bool
) -> None:
    """Equal variances halve the innovation and the variance.

    4 + 4 and 9 + 9 m2 at (4, 6) m give 16 / 8 + 36 / 18 = 4; a heading or speed 3 away with
    1.125 + 1.125 gives 9 / 2.25 = 4, too.
    """
    before = PoseBelief(7, np.array([1.0, 2.0, -1.0, 3.0]), np.diag([4.0, 9.0, 1.125, 1.125]))
    measured = [
        (update_heading(before, 2.0, 1.125, gate_nis), [3.0], [2]),
        (update_speed(before, 6.0, 1.125, gate_nis), [3.0], [3]),
    ]
    if is_position:
        xy_m, cov_m2 = np.array([5.0, 8.0]), np.diag([4.0, 9.0])
        measured = [(update_position(before, xy_m, cov_m2, gate_nis), [4.0, 6.0], [0, 1])]

    for updated, innovation, rows in measured:
        assert updated.innovation.tolist() == innovation
        assert updated.nis == pytest.approx(4.0)
        assert updated.is_accepted is (gate_nis != 3.999)
        if gate_nis == 3.999:
            assert updated.belief is before
            continue
        expected, cov = before.mean.copy(), before.cov.copy()
        expected[rows] += np.array(innovation) / 2
        cov[rows, rows] /= 2
        assert updated.belief.t_ns == 7
        np.testing.assert_allclose(updated.belief.mean, expected)
        np.testing.assert_allclose(updated.belief.cov, cov)


def test_car_is_lost_above_a_major_axis_of_100_metres() -> None:
    """Four s.d. of 25 m are 100 m, in any direction."""
    c, s = math.cos(0.7), math.sin(0.7)
    turned = np.array([[c, -s], [s, c]])
    cov = np.zeros((4, 4))
    cov[0, 0] = 625.0
    at_limit = PoseBelief(0, np.zeros(4), cov)
    cov = np.zeros((4, 4))
    cov[:2, :2] = turned @ np.diag([25.1**2, 3.0**2]) @ turned.T
    beyond = PoseBelief(0, np.zeros(4), cov)

    assert major_axis_m(at_limit) == 100.0
    assert major_axis_m(beyond) == pytest.approx(100.4)
    assert not is_lost(at_limit)
    assert is_lost(at_limit, lost_m=99.9)
    assert is_lost(beyond)


def test_reversing_along_the_same_circle_returns_to_the_start() -> None:
    start = PoseBelief(0, np.array([4.0, 1.0, 2.9, 6.0]), np.zeros((4, 4)))
    noise = MotionNoise(wheelbase_m=2.7)
    there = predict_ekf(start, 0.0, 0.3, 1.5, noise)
    turned_back = PoseBelief(there.t_ns, there.mean * [1, 1, 1, -1], there.cov)
    back = predict_ekf(turned_back, 0.0, 0.3, 1.5, noise)

    np.testing.assert_allclose(back.mean[:3], start.mean[:3], atol=1e-12)


@given(turn=st.floats(-3.0, 3.0), distance=st.floats(-50.0, 50.0))
@settings(max_examples=60, deadline=None)
def test_two_half_arcs_equal_one_arc(turn: float, distance: float) -> None:
    whole, half = arc(distance, turn), arc(distance / 2, turn / 2)
    c, s = math.cos(turn / 2), math.sin(turn / 2)

    assert whole.dx_m == pytest.approx(half.dx_m * (1 + c) - half.dy_m * s, abs=1e-10)
    assert whole.dy_m == pytest.approx(half.dy_m * (1 + c) + half.dx_m * s, abs=1e-10)


@pytest.mark.parametrize("turn", [0.0, 1e-12, 9.999e-3, 1.0001e-2, -9.999e-3, 0.5, -2.0])
def test_arc_derivatives_match_differences_around_zero_turn(turn: float) -> None:
    here = arc(7.0, turn)
    ahead, behind = arc(7.0, turn + 1e-6), arc(7.0, turn - 1e-6)

    assert here.dx_by_turn == pytest.approx((ahead.dx_m - behind.dx_m) / 2e-6, abs=1e-8)
    assert here.dy_by_turn == pytest.approx((ahead.dy_m - behind.dy_m) / 2e-6, abs=1e-8)
    assert here.dx_by_distance == pytest.approx(here.dx_m / 7.0, abs=1e-14)
    assert here.dy_by_distance == pytest.approx(here.dy_m / 7.0, abs=1e-14)


def test_arc_series_and_closed_form_agree_at_the_switch() -> None:
    below, above = arc(1.0, math.nextafter(1e-2, 0.0)), arc(1.0, 1e-2)

    np.testing.assert_allclose(below, above, rtol=0, atol=1e-13)


@given(heading=HEADINGS, speed=SPEEDS, accel=st.floats(-5.0, 5.0), steering=STEERINGS)
@settings(max_examples=60, deadline=None)
def test_bicycle_jacobians_match_central_differences(
    heading: float, speed: float, accel: float, steering: float
) -> None:
    mean, inputs = np.array([2.0, -1.0, heading, speed]), np.array([accel, steering])
    motion = bicycle(mean, accel, steering, 0.1, 2.7)
    by_state = central_differences(lambda m: bicycle(m, accel, steering, 0.1, 2.7).mean, mean)
    by_input = central_differences(lambda u: bicycle(mean, u[0], u[1], 0.1, 2.7).mean, inputs)

    np.testing.assert_allclose(motion.by_state, by_state, atol=1e-7)
    np.testing.assert_allclose(motion.by_input, by_input, atol=1e-7)


@given(heading=HEADINGS, speed=SPEEDS, steering=STEERINGS)
@settings(max_examples=40, deadline=None)
def test_steering_and_equivalent_yaw_rate_predict_the_same_pose(
    heading: float, speed: float, steering: float
) -> None:
    start = belief(heading=heading, speed=speed)
    noise = MotionNoise(wheelbase_m=2.7)
    steered = predict_ekf(start, 0.0, steering, 0.2, noise)
    turned = predict_yaw_rate(start, 0.0, speed * steering / 2.7, 0.2, noise)

    np.testing.assert_allclose(turned.mean, steered.mean, atol=1e-12)


def test_odometry_and_equivalent_yaw_rate_predict_the_same_pose() -> None:
    start = belief()
    turned = predict_yaw_rate(start, 0.0, 0.3, 0.5, NOISE)
    counted = predict_odometry(start, 8.0 * 0.5, 0.15, 0.0, 0.0, 0.5, 0.0)

    np.testing.assert_allclose(counted.mean, turned.mean, atol=1e-12)


@given(heading=HEADINGS, turn=st.floats(-1.0, 1.0), seed=st.integers(0, 50))
@settings(max_examples=30, deadline=None)
def test_prediction_commutes_with_rotation_of_the_map(
    heading: float, turn: float, seed: int
) -> None:
    start = belief(heading=heading, seed=seed)
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.eye(4)
    rotation[:2, :2] = [[c, -s], [s, c]]

    def rotated(b: PoseBelief) -> PoseBelief:
        mean = rotation @ b.mean
        mean[2] = wrap(mean[2] + turn)
        return PoseBelief(b.t_ns, mean, rotation @ b.cov @ rotation.T)

    first = predict_ekf(rotated(start), 0.4, 0.2, 0.3, NOISE)
    last = rotated(predict_ekf(start, 0.4, 0.2, 0.3, NOISE))
    np.testing.assert_allclose(first.cov, last.cov, atol=1e-9)
    np.testing.assert_allclose(wrap_all(first.mean - last.mean), 0.0, atol=1e-9)


def test_two_short_coasts_equal_one_long_coast() -> None:
    start = belief(speed=9.0)
    long = coast(start, 2.0, 0.5, 0.01)
    short = coast(coast(start, 0.7, 0.5, 0.01), 1.3, 0.5, 0.01)

    np.testing.assert_allclose(short.mean, long.mean, atol=1e-12)
    np.testing.assert_allclose(short.cov, long.cov, rtol=1e-9, atol=1e-9)


def test_heading_update_across_half_a_turn_takes_the_shorter_way() -> None:
    start = belief(heading=math.radians(179.0))
    updated = update_heading(start, math.radians(-179.0), 1e-12)

    assert updated.innovation[0] == pytest.approx(math.radians(2.0))
    assert updated.belief.mean[2] == pytest.approx(math.radians(-179.0), abs=1e-6)


def test_order_of_measurements_at_one_time_does_not_matter() -> None:
    start = belief()
    xy, cov = np.array([3.5, -2.5]), np.array([[2.0, 0.4], [0.4, 1.0]])
    one = update_heading(update_position(start, xy, cov).belief, 0.5, 0.01).belief
    other = update_position(update_heading(start, 0.5, 0.01).belief, xy, cov).belief

    np.testing.assert_allclose(one.mean, other.mean, atol=1e-12)
    np.testing.assert_allclose(one.cov, other.cov, atol=1e-12)


@given(seed=st.integers(0, 500), steps=st.integers(1, 30))
@settings(max_examples=25, deadline=None)
def test_covariance_stays_symmetric_and_positive(seed: int, steps: int) -> None:
    rng = np.random.default_rng(seed)
    now = belief(seed=seed)
    for _ in range(steps):
        now = predict_ekf(now, rng.normal(), rng.normal(0.0, 0.3), 0.1, NOISE)
        now = update_heading(now, rng.uniform(-3.0, 3.0), 1e-6).belief
        now = update_speed(now, rng.normal(5.0, 5.0), 1e-6).belief
        now = update_position(now, rng.normal(size=2), np.diag([1e-6, 1e4])).belief

        np.testing.assert_array_equal(now.cov, now.cov.T)
        assert np.linalg.eigvalsh(now.cov).min() > -1e-9
        assert -math.pi < now.mean[2] <= math.pi


def test_lateral_variance_on_a_straight_drive_follows_the_range_law() -> None:
    """A compass of variance r, read every ds metres, yields a lateral variance of r * ds * D."""
    r, ds_m, distance_m = math.radians(15.0) ** 2, 1.0, 2_000
    now = PoseBelief(0, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros((4, 4)))
    for _ in range(distance_m):
        now = predict_odometry(now, ds_m, 0.0, 0.0, 1e-4, 1.0, 0.0)
        now = update_heading(now, 0.0, r).belief

    assert now.cov[1, 1] == pytest.approx(r * ds_m * distance_m, rel=0.05)


def test_filter_matches_filterpy_on_the_same_inputs() -> None:
    from filterpy.kalman import ExtendedKalmanFilter

    def observe(rows: list[int]) -> Callable[[Floats], Floats]:
        return lambda _state: np.eye(4)[rows]

    def measured(rows: list[int]) -> Callable[[Floats], Floats]:
        return lambda state: state[rows]

    def apart(z: Floats, expected: Floats) -> Floats:
        return wrap_all(z - expected)

    rng = np.random.default_rng(3)
    ours = belief(heading=3.0)
    theirs = ExtendedKalmanFilter(dim_x=4, dim_z=1)
    theirs.x, theirs.P = ours.mean.copy(), ours.cov.copy()
    for step in range(200):
        accel, steering = rng.normal(0.0, 1.0), rng.normal(0.05, 0.2)
        motion = bicycle(theirs.x, accel, steering, 0.1, NOISE.wheelbase_m)
        along = np.array([math.cos(theirs.x[2]), math.sin(theirs.x[2]), 0.0, 0.0])
        distance_m = abs(theirs.x[3] * 0.1 + 0.005 * accel)
        inputs = np.diag([NOISE.accel_mps2**2, NOISE.steering_rad**2])
        theirs.F = motion.by_state
        theirs.Q = motion.by_input @ inputs @ motion.by_input.T
        theirs.Q = theirs.Q + 0.05**2 * distance_m * np.outer(along, along)
        theirs.predict_x = lambda _u, after=motion.mean: setattr(theirs, "x", after)
        theirs.predict()
        ours = predict_ekf(ours, accel, steering, 0.1, NOISE)

        speed, heading, xy = rng.normal(8, 1), rng.uniform(-9, 9), rng.normal(0, 20, 2)
        theirs.update(np.array([speed]), observe([3]), measured([3]), R=0.1)
        ours = update_speed(ours, speed, 0.1).belief
        theirs.update(np.array([heading]), observe([2]), measured([2]), R=0.3, residual=apart)
        theirs.x[2] = wrap(theirs.x[2])
        ours = update_heading(ours, heading, 0.3).belief
        if step % 20 == 0:
            cov = np.array([[4.0, 1.0], [1.0, 2.0]])
            theirs.update(xy, observe([0, 1]), measured([0, 1]), R=cov)
            theirs.x[2] = wrap(theirs.x[2])
            ours = update_position(ours, xy, cov).belief

        np.testing.assert_allclose(ours.mean, theirs.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ours.cov, theirs.P, rtol=1e-9, atol=1e-9)


REFUSALS: list[tuple[Callable[[], object], str]] = [
    (
        lambda: predict_ekf(belief(), math.nan, 0, 0.1, NOISE),
        "accel_mps2: expected a finite number",
    ),
    (
        lambda: predict_ekf(belief(), 0, math.inf, 0.1, NOISE),
        "steering_rad: expected a finite number",
    ),
    (lambda: predict_ekf(belief(), 0, 0, -0.1, NOISE), "dt_s: expected finite and >= 0"),
    (lambda: predict_ekf(belief(), 0, 0, math.inf, NOISE), "dt_s: expected finite and >= 0"),
    (lambda: predict_yaw_rate(belief(), math.nan, 0, 1, NOISE), "accel_mps2: expected a finite"),
    (lambda: predict_yaw_rate(belief(), 0, math.nan, 1, NOISE), "yaw_rate_radps: expected a fini"),
    (lambda: predict_odometry(belief(), math.nan, 0, 0, 0, 1, 0), "distance_m: expected a finite"),
    (lambda: predict_odometry(belief(), 1, math.nan, 0, 0, 1, 0), "turn_rad: expected a finite"),
    (lambda: predict_odometry(belief(), 1, 0, -1, 0, 1, 0), "variances: expected >= 0, got -1, 0$"),
    (lambda: predict_odometry(belief(), 1, 0, 0, -1, 1, 0), "variances: expected >= 0, got 0, -1$"),
    (lambda: predict_odometry(belief(), 1, 0, 0, 0, 1, -1), "variances: expected >= 0, got 0, 0$"),
    (lambda: coast(belief(), 1, -1, 0), "variances: expected >= 0, got -1, 0$"),
    (lambda: coast(belief(), 1, 0, -1), "variances: expected >= 0, got 0, -1$"),
    (lambda: coast(belief(), 1, math.nan, 0), "accel_var_m2ps3: expected a finite number, got nan"),
    (lambda: coast(belief(), 1, 0, math.nan), "turn_var_rad2ps: expected a finite number, got nan"),
    (
        lambda: update_heading(belief(), math.nan, 1),
        "measurement: expected finite numbers, got NaN",
    ),
    (
        lambda: update_heading(belief(), math.inf, 1),
        "measurement: expected finite numbers, got NaN",
    ),
    (lambda: update_speed(belief(), 1, math.nan), "measurement: .* got NaN or infinity$"),
    (lambda: update_speed(belief(), 1, 0), r"measurement covariance: .* definite, got \[\[0"),
    (lambda: update_position(belief(), np.zeros(3), np.eye(2)), r"xy_m: expected \(2,\), got \(3"),
    (
        lambda: update_position(belief(), np.zeros(2), np.eye(3)),
        r"measurement covariance: expected \(2, 2\), got \(3, 3\)$",
    ),
    (
        lambda: update_position(belief(), np.zeros(2), np.array([[1.0, 2.0], [2.0, 1.0]])),
        "measurement covariance: expected positive definite, got",
    ),
    (
        lambda: update_position(belief(), np.zeros(2), np.array([[1.0, 0.5], [0.0, 1.0]])),
        "measurement covariance: expected positive definite, got",
    ),
    (lambda: MotionNoise(0.0), "wheelbase_m: expected > 0, got 0.0$"),
    *(
        (partial(MotionNoise, 2.7, **{name: -1.0}), f"{name}: expected >= 0, got -1.0$")
        for name in ("accel_mps2", "steering_rad", "yaw_rate_radps", "slip_per_sqrt_m")
    ),
    (lambda: PoseBelief(0, np.zeros(3), np.eye(4)), r"expected mean \(4,\), .* got \(3,\), \(4"),
    (lambda: PoseBelief(0, np.zeros(4), np.eye(3)), r"expected mean \(4,\), .* got \(4,\), \(3"),
    (lambda: PoseBelief(9, np.full(4, np.nan), np.eye(4)), "belief at 9 ns: expected finite"),
    (lambda: PoseBelief(9, np.zeros(4), np.full((4, 4), np.inf)), "belief at 9 ns: expected finit"),
    (lambda: PoseBelief(0, np.zeros(4), -np.eye(4)), "cov: expected variances >= 0, got"),
]


@pytest.mark.parametrize(("call", "message"), REFUSALS)
def test_invalid_arguments_are_refused(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        call()


def test_limits_of_arguments_are_accepted() -> None:
    """A step of no length, and a variance that rounding made negative."""
    rounded = PoseBelief(0, np.zeros(4), np.diag([-1e-9, 0.0, 0.0, 0.0]))

    assert predict_ekf(rounded, 0.0, 0.0, 0.0, MotionNoise(0.5)).mean.tolist() == [0.0] * 4


@given(angle=st.floats(-1e6, 1e6))
@settings(max_examples=100, deadline=None)
def test_wrapping_keeps_the_direction(angle: float) -> None:
    wrapped = wrap(angle)

    assert -math.pi - 1e-9 < wrapped <= math.pi + 1e-9
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-8)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-8)
    assert wrap_all(np.array([angle]))[0] == wrapped


def test_half_a_turn_wraps_to_plus_pi() -> None:
    assert wrap(math.pi) == math.pi
    assert wrap(-math.pi) == pytest.approx(math.pi)
    assert wrap(0.3) == 0.3
