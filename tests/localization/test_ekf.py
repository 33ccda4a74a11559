"""The pose filter, compared with filterpy, and the batch smoother."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from crosscue.eval.scoring.consistency import mean_band
from crosscue.localization.angles import wrap, wrap_all
from crosscue.localization.constants import NO_CONSTANTS, Constants, effects
from crosscue.localization.ekf import (
    PoseBelief,
    coast,
    odometry_derivatives,
    pack_belief,
    update_point,
)
from crosscue.localization.fixes import Fixes
from crosscue.localization.odometry import Increments, OdometrySettings, WheelSamples, integrate
from crosscue.localization.pose_filter import arc, major_axis_m, update_position
from crosscue.localization.pose_track import (
    NO_HEADINGS,
    Headings,
    TrackSettings,
    TrackState,
    advance_pose,
    start_belief,
)
from crosscue.localization.smoother import smooth_poses
from crosscue.replay.columns import Floats, Int64s
from support.beliefs import driven, with_heading, with_position, with_speed
from support.simulated_drive import TRACK_M, Truth, compass, drive, gyro, wheels

HEADINGS = st.floats(-math.pi, math.pi)
NOISE = (0.01, 0.002, 0.05)


def belief(y: float = -2.0, heading: float = 0.4, speed: float = 8.0, seed: int = 1) -> PoseBelief:
    root = np.random.default_rng(seed).normal(size=(4, 4)) * [[1.0], [1.0], [0.05], [0.5]]
    return PoseBelief(1_000, np.array([3.0, y, heading, speed]), root @ root.T)


def moved(
    mean: NDArray[np.complexfloating], distance: complex, turn: complex
) -> NDArray[np.complex128]:
    """Equation 6 for a turn other than zero, on complex numbers."""
    x, y, heading, speed = mean
    dx = distance * np.sin(turn) / turn
    dy = distance * (1.0 - np.cos(turn)) / turn
    c, s = np.cos(heading), np.sin(heading)
    return np.array([x + c * dx - s * dy, y + s * dx + c * dy, heading + turn, speed])


def derivatives(mean: Floats, distance: float, turn: float) -> tuple[Floats, Floats]:
    """Exact derivatives by state and by (distance, turn), by complex steps."""
    step = 1e-30j
    by_state = [moved(mean + step * row, distance, turn).imag / 1e-30 for row in np.eye(4)]
    by_input = [
        moved(mean + 0j, distance + step, turn).imag / 1e-30,
        moved(mean + 0j, distance, turn + step).imag / 1e-30,
    ]
    return np.column_stack(by_state), np.column_stack(by_input)


@given(heading=HEADINGS, distance=st.floats(-40.0, 40.0), turn=st.floats(0.02, 1.5))
def test_derivatives_match_complex_steps(heading: float, distance: float, turn: float) -> None:
    expected = derivatives(np.array([2.0, -1.0, heading, 3.0]), distance, turn)
    found = odometry_derivatives(heading, distance, turn, np.eye(2))

    for here, there in zip(found, expected, strict=True):
        np.testing.assert_allclose(here, there, atol=1e-9)
    assert odometry_derivatives(heading, distance, turn, np.empty((2, 0)))[1].shape == (4, 0)


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


def test_gate_accepts_up_to_its_normalised_innovation_squared() -> None:
    """4 + 4 and 9 + 9 m2 at (4, 6) m give 16 / 8 + 36 / 18 = 4; equal variances halve both."""
    before = PoseBelief(7, np.array([1.0, 2.0, -1.0, 3.0]), np.diag([4.0, 9.0, 1.125, 1.125]))
    state = pack_belief(before)
    accepted = update_position(state, 5.0, 8.0, 4.0, 0.0, 9.0, 4.0)
    rejected = update_position(state, 5.0, 8.0, 4.0, 0.0, 9.0, 3.999)

    assert (accepted.is_accepted, rejected.is_accepted) == (True, False)
    assert accepted.nis == rejected.nis == pytest.approx(4.0)
    assert rejected.state == state
    after = accepted.state
    assert (after.x_m, after.y_m, after.xx, after.yy) == pytest.approx((3.0, 5.0, 2.0, 4.5))
    assert with_heading(before, 2.0, 1.125).mean[2] == pytest.approx(0.5)
    assert with_speed(before, 6.0, 1.125).mean[3] == pytest.approx(4.5)


def test_major_axis_is_four_standard_deviations_in_any_direction() -> None:
    c, s = math.cos(0.7), math.sin(0.7)
    turned = np.array([[c, -s], [s, c]])
    (xx, xy), (_, yy) = turned @ np.diag([25.1**2, 3.0**2]) @ turned.T

    assert major_axis_m(625.0, 0.0, 0.0) == 100.0
    assert major_axis_m(xx, xy, yy) == pytest.approx(100.4)


@given(turn=st.floats(-3.0, 3.0), distance=st.floats(-50.0, 50.0))
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


def test_two_short_coasts_equal_one_long_coast() -> None:
    start = belief(speed=9.0)
    long = coast(start, 2.0, 0.5, 0.01)
    short = coast(coast(start, 0.7, 0.5, 0.01), 1.3, 0.5, 0.01)

    np.testing.assert_allclose(short.mean, long.mean, atol=1e-12)
    np.testing.assert_allclose(short.cov, long.cov, rtol=1e-9, atol=1e-9)


@given(seed=st.integers(0, 500), steps=st.integers(1, 30))
@settings(max_examples=25)
def test_covariance_stays_symmetric_and_positive(seed: int, steps: int) -> None:
    rng = np.random.default_rng(seed)
    now = belief(seed=seed)
    for _ in range(steps):
        now = driven(now, rng.normal(), rng.normal(0.0, 0.3), NOISE)
        now = with_heading(now, rng.uniform(-3.0, 3.0), 1e-6)
        now = with_speed(now, rng.normal(5.0, 5.0), 1e-6)
        now = with_position(now, rng.normal(size=2), np.diag([1e-6, 1e4]))

        np.testing.assert_array_equal(now.cov, now.cov.T)
        assert np.linalg.eigvalsh(now.cov).min() > -1e-9
        assert -math.pi < now.mean[2] <= math.pi


def test_lateral_variance_on_a_straight_drive_follows_the_range_law() -> None:
    """A compass of variance r, read every ds metres, yields a lateral variance of r * ds * D."""
    r, ds_m, distance_m = math.radians(15.0) ** 2, 1.0, 2_000
    now = PoseBelief(0, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros((4, 4)))
    for _ in range(distance_m):
        now = driven(now, ds_m, 0.0, (0.0, 1e-4, 0.0))
        now = with_heading(now, 0.0, r)

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
        distance_m, turn_rad = rng.normal(0.8, 0.1), rng.uniform(0.01, 0.05)
        theirs.F, by_input = derivatives(theirs.x, distance_m, turn_rad)
        theirs.Q = by_input @ np.diag(NOISE[:2]) @ by_input.T + np.diag([0, 0, 0, NOISE[2]])
        after = moved(theirs.x + 0j, distance_m, turn_rad).real
        theirs.predict_x = lambda _u, after=after: setattr(theirs, "x", after)
        theirs.predict()
        ours = driven(ours, distance_m, turn_rad, NOISE)

        speed, heading, xy = rng.normal(8, 1), rng.uniform(-9, 9), rng.normal(0, 20, 2)
        theirs.update(np.array([speed]), observe([3]), measured([3]), R=0.1)
        ours = with_speed(ours, speed, 0.1)
        theirs.update(np.array([heading]), observe([2]), measured([2]), R=0.3, residual=apart)
        theirs.x[2] = wrap(theirs.x[2])
        ours = with_heading(ours, heading, 0.3)
        if step % 20 == 0:
            cov = np.array([[4.0, 1.0], [1.0, 2.0]])
            theirs.update(xy, observe([0, 1]), measured([0, 1]), R=cov)
            theirs.x[2] = wrap(theirs.x[2])
            ours = with_position(ours, xy, cov)

        np.testing.assert_allclose(ours.mean, theirs.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ours.cov, theirs.P, rtol=1e-9, atol=1e-9)


REFUSALS: list[tuple[Callable[[], object], str]] = [
    (lambda: coast(belief(), -0.1, 0, 0), "dt_s: expected finite and >= 0, got -0.1"),
    (lambda: coast(belief(), math.inf, 0, 0), "dt_s: expected finite and >= 0, got inf"),
    (lambda: coast(belief(), 1, -1, 0), "accel_var_m2ps3: expected finite and >= 0, got -1"),
    (lambda: coast(belief(), 1, 0, math.nan), "turn_var_rad2ps: expected finite and >= 0, got nan"),
    (lambda: PoseBelief(0, np.zeros(3), np.eye(4)), r"expected mean \(4,\), .* got \(3,\), \(4"),
    (lambda: PoseBelief(0, np.zeros(4), np.eye(3)), r"expected mean \(4,\), .* got \(4,\), \(3"),
    (lambda: PoseBelief(9, np.full(4, np.nan), np.eye(4)), "belief at 9 ns: expected finite"),
    (lambda: PoseBelief(9, np.zeros(4), np.full((4, 4), np.inf)), "belief at 9 ns: expected finit"),
    (lambda: PoseBelief(0, np.zeros(4), -np.eye(4)), "cov: expected variances >= 0, got"),
    (
        lambda: update_point(belief(), np.array([math.nan, 0.0]), np.eye(2)),
        "position: expected fin",
    ),
    (lambda: update_point(belief(), np.zeros(2), np.full((2, 2), math.nan)), "position: expected"),
]


@pytest.mark.parametrize(("call", "message"), REFUSALS)
def test_invalid_arguments_are_refused(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        call()


def test_variance_that_rounding_made_negative_is_accepted() -> None:
    rounded = PoseBelief(0, np.zeros(4), np.diag([-1e-9, 0.0, 0.0, 0.0]))

    assert coast(rounded, 0.0, 0.0, 0.0).mean.tolist() == [0.0] * 4


@given(angle=st.floats(-1e6, 1e6))
@settings(max_examples=100)
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


ODOMETRY = OdometrySettings(
    track_width_m=TRACK_M, wheel_step_mps=0.01, slip_per_sqrt_m=0.1, gyro_noise_rad_per_sqrt_s=0.01
)
EVERY_READING = TrackSettings(heading_interval_m=0.0, heading_gate_nis=None)


def straight(n: int, slip: float) -> Increments:
    t_ns = np.arange(n + 1, dtype=np.int64) * 1_000_000_000
    settings = OdometrySettings(
        track_width_m=TRACK_M, slip_per_sqrt_m=slip, wheel_turn_rad_per_sqrt_m=0.0, max_gap_s=2.0
    )
    return integrate(WheelSamples(t_ns, np.full((n + 1, 2), 10.0)), settings).increments


def test_straight_drive_matches_the_least_squares_solution() -> None:
    """With known heading and slip only, positions are a chain of Gaussians with a closed form."""
    slip, fix_var, start_var = 0.5, 4.0, 9.0
    made = straight(10, slip)
    start = start_belief(0, 3.0, 0.0, 0.0, 10.0, math.sqrt(start_var), 1e-4, 1.0)
    fixes = Fixes(
        np.array([4, 10]) * 1_000_000_000,
        np.array([[42.0, 0.0], [97.0, 0.0]]),
        np.tile(fix_var * np.eye(2), (2, 1, 1)),
    )
    at = np.arange(11, dtype=np.int64) * 1_000_000_000
    found = smooth_poses(start, made, NO_HEADINGS, fixes, at)

    step_var = float(made.distance_var_m2[0])
    information = np.zeros((11, 11))
    vector = np.zeros(11)
    information[0, 0], vector[0] = 1 / start_var, 3.0 / start_var
    for i in range(10):
        pull = np.zeros(11)
        pull[i], pull[i + 1] = -1.0, 1.0
        information += np.outer(pull, pull) / step_var
        vector += pull * 10.0 / step_var
    for i, x in ((4, 42.0), (10, 97.0)):
        information[i, i] += 1 / fix_var
        vector[i] += x / fix_var
    cov = np.linalg.inv(information)
    np.testing.assert_allclose(found.xyh[:, 0], cov @ vector, atol=1e-4)
    np.testing.assert_allclose(found.cov[:, 0, 0], np.diag(cov), rtol=1e-4)
    np.testing.assert_allclose(found.xyh[:, 1], 0.0, atol=1e-6)


def simulate(seed: int) -> tuple[Truth, PoseBelief, Increments, Headings, Fixes]:
    rng = np.random.default_rng(seed)
    truth = drive(rng, seconds=30.0)
    made = integrate(wheels(truth, ODOMETRY, rng), ODOMETRY, gyro(truth, ODOMETRY, rng)).increments
    off = rng.normal(0.0, [2.0, 2.0, 0.1])
    x, y, heading = truth.xyh[0] + off
    first = start_belief(int(truth.t_ns[0]), x, y, heading, truth.speed_mps[0], 2.0, 0.1, 1.0)
    headings = compass(truth, 0.2, rng, every=20)
    rows = np.arange(100, len(truth.t_ns), 150)
    cov = np.tile(np.array([[2.0, 0.5], [0.5, 1.0]]), (len(rows), 1, 1))
    noise = rng.multivariate_normal([0.0, 0.0], cov[0], len(rows))
    return truth, first, made, headings, Fixes(truth.t_ns[rows], truth.xyh[rows, :2] + noise, cov)


class FixMeasurements:
    """Fixes as measurements of the filter."""

    def __init__(self, fixes: Fixes) -> None:
        self.fixes = fixes

    def times_ns(self) -> list[int]:
        """Times of the fixes."""
        return [int(t) for t in self.fixes.t_ns]

    def update(self, belief: PoseBelief, travelled_m: float, /) -> PoseBelief | None:
        """Update with one fix."""
        i = int(np.searchsorted(self.fixes.t_ns, belief.t_ns))
        return update_point(belief, self.fixes.xy_m[i], self.fixes.cov_m2[i]).belief


def errors(truth: Truth, t_ns: Int64s, xyh: Floats) -> Floats:
    error: Floats = xyh - truth.xyh[np.searchsorted(truth.t_ns, t_ns)]
    error[:, 2] = wrap_all(error[:, 2])
    return error


@pytest.mark.slow
def test_smoother_is_consistent_and_more_accurate_than_the_filter() -> None:
    """Seeds 0 to 29: both agree at the end of a drive, and the smoother is better before it."""
    nees, filter_m2, smoother_m2, ends = [], [], [], []
    for seed in range(30):
        truth, first, made, headings, fixes = simulate(seed)
        at = truth.t_ns[20::20]
        measurements = FixMeasurements(fixes)
        track = advance_pose(
            TrackState(first), made, EVERY_READING, headings, at, measurements
        ).poses
        found = smooth_poses(first, made, headings, fixes, at)
        error = errors(truth, found.t_ns, found.xyh)
        nees.append(float(error[15] @ np.linalg.solve(found.cov[15], error[15])))
        smoother_m2.append(np.mean(np.sum(error[:, :2] ** 2, axis=1)))
        filtered = np.column_stack([track.x_m, track.y_m, track.heading_rad])
        filter_error = errors(truth, track.t_ns, filtered)
        filter_m2.append(np.mean(np.sum(filter_error[:, :2] ** 2, axis=1)))
        ends.append(math.dist(found.xyh[-1, :2], filtered[-1, :2]))

    low, high = mean_band(3, 30)
    assert low < np.mean(nees) < high
    assert np.sqrt(np.mean(smoother_m2)) < 0.9 * np.sqrt(np.mean(filter_m2))
    assert np.median(ends) < 0.2


def test_constant_errors_of_the_odometry_are_states_with_true_variances() -> None:
    """Seeds 100 to 139, with a scale and a bias that are off by their s.d. on average."""
    names, sd = ("wheel_scale", "gyro_bias_radps"), np.array([0.05, 0.02])
    nees: dict[str, list[float]] = {"states": [], "none": []}
    for seed in range(100, 140):
        rng = np.random.default_rng(seed)
        truth, first, _, headings, fixes = simulate(seed)
        scale, bias = rng.normal(0.0, sd).tolist()
        car = replace(ODOMETRY, wheel_scale=1.0 - scale, gyro_bias_radps=-bias)
        made = integrate(wheels(truth, ODOMETRY, rng), car, gyro(truth, ODOMETRY, rng)).increments
        cov = np.diag(sd**2)
        known = Constants(names, np.zeros(2), cov, np.zeros((4, 2)), np.zeros(2))
        at = truth.t_ns[20::20]
        for name, constants in (("states", known), ("none", NO_CONSTANTS)):
            by = effects(made, car, constants.names)
            found = smooth_poses(first, made, headings, fixes, at, (0.0, 0.0), (constants, by))
            error = errors(truth, found.t_ns, found.xyh)
            nees[name].append(float(error[15] @ np.linalg.solve(found.cov[15], error[15])))

    low, high = mean_band(3, 40)
    assert low < np.mean(nees["states"]) < high
    assert np.mean(nees["none"]) > 2.0 * high


def test_gaps_are_refused() -> None:
    made = straight(4, 0.5)
    late = start_belief(9_000_000_000, 0.0, 0.0, 0.0)
    early = start_belief(-1, 0.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="expected odometry after 9000000000 ns"):
        smooth_poses(late, made, NO_HEADINGS)
    with pytest.raises(ValueError, match="expected no gaps, got one at -1 ns"):
        smooth_poses(early, made, NO_HEADINGS)
