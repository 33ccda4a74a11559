"""The compass, front wheels, GNSS positions and navigation."""

import math
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.localization.angles import circular_mean, interpolate_angle, wrap_all
from crosscue.localization.compass import CompassSettings, Matrix, heading
from crosscue.localization.fit.compass import (
    HARD_IRON,
    MOUNTING,
    SOFT_IRON,
    CompassFit,
    fit_compass,
    persistence,
)
from crosscue.localization.fit.front_wheels import front_wheels
from crosscue.localization.fixes import Fixes
from crosscue.localization.navigation import (
    NONE,
    Memory,
    bearing_after,
    choose_option,
    empty_memory,
    landmark_ahead,
    option_cost,
    penalty,
    recognise,
    remember,
)
from crosscue.localization.odometry import OdometrySettings, WheelSamples, integrate
from crosscue.localization.pose_track import BothSources, start_belief
from crosscue.localization.position_updates import PositionUpdates
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import VehicleError
from support.beliefs import joseph
from support.simulated_drive import BASE_M, TRACK_M, Truth, drive, gyro, wheels

DOWN_T = 42e-6
LEVEL_T = 23e-6
FRD_TO_FLU: Matrix = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
IRON = CompassSettings(
    mounting_rotation=FRD_TO_FLU,
    mounting_yaw_rad=0.4,
    hard_iron_t=(12e-6, -9e-6, 0.0),
    soft_iron=((1.1, 0.08, 0.0), (0.08, 0.92, 0.0), (0.0, 0.0, 1.0)),
    declination_rad=0.23,
)


def readings(heading_rad: Floats, compass: CompassSettings, sd_t: float = 0.0) -> Floats:
    """Simulate the magnetometer of a level car with this heading."""
    north = math.pi / 2 - compass.declination_rad - heading_rad - compass.mounting_yaw_rad
    level = np.column_stack(
        [LEVEL_T * np.cos(north), LEVEL_T * np.sin(north), np.full(len(north), -DOWN_T)]
    )
    sensor = level @ np.array(compass.mounting_rotation)
    raw = np.linalg.solve(np.array(compass.soft_iron), sensor.T).T + compass.hard_iron_t
    return raw + np.random.default_rng(0).normal(0.0, sd_t, raw.shape)


def times(n: int, period_s: float = 0.1) -> Int64s:
    return np.round(np.arange(n) * period_s * 1e9).astype(np.int64)


def max_difference_deg(a: Floats, b: Floats) -> float:
    return float(np.degrees(np.abs(wrap_all(a - b)).max()))


def headings_over(fraction: float, n: int = 600) -> Floats:
    return wrap_all(np.linspace(0.0, fraction * 2 * math.pi, n) + 0.3)


def test_facing_magnetic_north_is_a_quarter_turn_from_east() -> None:
    north = np.array([[LEVEL_T, 0.0, -DOWN_T]])

    assert heading(north, CompassSettings())[0] == pytest.approx(math.pi / 2)
    east_of_north = heading(north, CompassSettings(declination_rad=0.2))[0]
    assert east_of_north == pytest.approx(math.pi / 2 - 0.2)


@given(true=st.floats(-3.1, 3.1))
def test_corrections_undo_iron_and_mounting(true: float) -> None:
    found = heading(readings(np.array([true]), IRON), IRON)

    assert max_difference_deg(found, np.array([true])) < 1e-9


def check_correct(fit: CompassFit, limit_deg: float) -> None:
    everywhere = headings_over(1.0)
    assert (
        max_difference_deg(heading(readings(everywhere, IRON), fit.settings), everywhere)
        < limit_deg
    )


def without_calibration(compass: CompassSettings) -> CompassSettings:
    return CompassSettings(
        mounting_rotation=compass.mounting_rotation, declination_rad=compass.declination_rad
    )


def test_full_circle_makes_mounting_and_iron_observable() -> None:
    truth = headings_over(2.5)
    fit = fit_compass(times(600), readings(truth, IRON), truth, without_calibration(IRON))

    assert fit.observable == (MOUNTING, HARD_IRON, SOFT_IRON)
    assert fit.coverage_deg == 360
    assert fit.settings.mounting_yaw_rad == pytest.approx(0.4, abs=0.05)
    np.testing.assert_allclose(fit.settings.hard_iron_t[:2], IRON.hard_iron_t[:2], atol=1e-12)
    check_correct(fit, 1e-6)


def test_residual_sd_of_the_fit_matches_the_noise() -> None:
    """Simulated noise of 0.5 uT on a level field of 23 uT: about 1.25 degrees."""
    truth = headings_over(2.5, 3000)
    noisy = readings(truth, IRON, sd_t=0.5e-6)
    fit = fit_compass(times(3000), noisy, truth, without_calibration(IRON))

    assert math.degrees(fit.residual_sd_rad) == pytest.approx(1.25, rel=0.15)
    assert fit.persists_s < 0.1
    check_correct(fit, 0.4)


def test_half_circle_makes_hard_iron_observable_but_not_soft_iron() -> None:
    hard = replace(IRON, soft_iron=CompassSettings().soft_iron)
    truth = headings_over(0.6)
    fit = fit_compass(times(600), readings(truth, hard), truth, without_calibration(hard))

    assert fit.observable == (MOUNTING, HARD_IRON)
    assert "soft iron" in [missing.parameter for missing in fit.not_observable]
    np.testing.assert_allclose(fit.settings.hard_iron_t[:2], hard.hard_iron_t[:2], atol=1e-12)
    assert fit.settings.mounting_yaw_rad == pytest.approx(0.4)


def test_straight_drive_makes_only_the_mounting_observable() -> None:
    rng = np.random.default_rng(1)
    truth = 1.3 + rng.normal(0.0, 0.01, 600)
    given = replace(without_calibration(IRON), hard_iron_t=(1e-6, 2e-6, 0.0))
    fit = fit_compass(times(600), readings(truth, IRON), truth, given)

    assert fit.observable == (MOUNTING,)
    reasons = dict(fit.not_observable)
    assert reasons["hard iron"] == "headings cover 10 of 360 degrees, 180 are required"
    assert reasons["soft iron"] == "headings cover 10 of 360 degrees, 300 are required"
    assert set(reasons) >= {"declination", "hard iron, upward part"}
    assert fit.settings.hard_iron_t == given.hard_iron_t
    assert fit.settings.soft_iron == given.soft_iron
    found = heading(readings(np.array([1.3]), IRON), fit.settings)
    assert max_difference_deg(found, np.array([1.3])) < 0.2


def test_full_circle_without_reference_makes_only_iron_observable() -> None:
    truth = headings_over(1.5)
    fit = fit_compass(times(600), readings(truth, IRON), None, without_calibration(IRON))

    assert fit.observable == (HARD_IRON, SOFT_IRON)
    assert MOUNTING in [missing.parameter for missing in fit.not_observable]
    assert math.isnan(fit.residual_sd_rad)
    apart = wrap_all(heading(readings(truth, IRON), fit.settings) - truth)
    assert np.std(wrap_all(apart - circular_mean(apart))) < 1e-8


def test_half_circle_without_reference_makes_nothing_observable() -> None:
    truth = headings_over(0.6)
    fit = fit_compass(times(600), readings(truth, IRON), None, without_calibration(IRON))

    assert fit.observable == ()
    assert dict(fit.not_observable)["soft iron"].startswith("headings cover 2")


@pytest.mark.parametrize("fraction", [0.6, 2.0])
def test_mirrored_axes_are_refused(fraction: float) -> None:
    truth = headings_over(fraction)
    mirrored = readings(truth, IRON) * [1.0, -1.0, 1.0]
    with pytest.raises(VehicleError, match="turn in the wrong direction"):
        fit_compass(times(600), mirrored, truth, without_calibration(IRON))


@pytest.mark.parametrize("persists_s", [0.5, 3.0])
def test_persistence_recovers_the_correlation_time_of_errors(persists_s: float) -> None:
    """Residuals are simulated with exponential correlation at 10 Hz for an hour."""
    rng = np.random.default_rng(2)
    n, kept = 36_000, math.exp(-0.1 / persists_s)
    residual = np.zeros(n)
    kicks = rng.normal(0.0, math.sqrt(1 - kept**2), n)
    for i in range(1, n):
        residual[i] = kept * residual[i - 1] + kicks[i]
    found = persistence(times(n), residual)

    assert found.seconds == pytest.approx(persists_s, rel=0.2)
    assert found.next_correlation == pytest.approx(kept, abs=0.02)
    assert found.independent == pytest.approx(3600.0 / (2 * persists_s), rel=0.25)
    assert not found.is_bound


def test_interpolated_angles_take_the_shorter_way() -> None:
    t_ns = np.array([0, 10], np.int64)
    found = interpolate_angle(np.array([-1, 0, 5, 10, 11]), t_ns, np.array([3.0, -3.0]))

    assert np.isnan(found[[0, 4]]).all()
    assert max_difference_deg(found[1:4], np.array([3.0, math.pi, -3.0])) < 1e-9
    assert np.isnan(interpolate_angle(t_ns, np.empty(0, np.int64), np.empty(0))).all()


SECOND = 1_000_000_000
LEVER_M = (1.3, -0.4)
COV = np.array([[2.0, 0.3], [0.3, 1.0]])


def fixes(*rows: tuple[int, float, float]) -> Fixes:
    return Fixes(
        np.array([t for t, _, _ in rows], np.int64),
        np.array([[x, y] for _, x, y in rows]),
        np.tile(COV, (len(rows), 1, 1)),
    )


def test_position_update_applies_the_antenna_lever() -> None:
    belief = start_belief(SECOND, 4.0, 5.0, 0.7, 8.0, 1.5, 0.02, 0.5)
    measurements = PositionUpdates(LEVER_M)
    measurements.add(fixes((SECOND, 5.5, 5.2)))
    found = measurements.update(belief, 0.0)
    wanted = joseph(belief, np.array([5.5, 5.2]), COV, LEVER_M)

    assert found is not None
    # The Joseph form is linear in the heading; this one rotates the lever.
    np.testing.assert_allclose(found.mean, wanted.mean, atol=2e-4)
    np.testing.assert_allclose(found.cov, wanted.cov, atol=2e-3)


def test_late_rejected_and_thinned_positions_are_counted() -> None:
    belief = start_belief(SECOND, 0.0, 0.0, 0.0, 0.0, 1.0)
    measurements = PositionUpdates(interval_s=1.0)
    measurements.add(
        fixes((SECOND // 2, 0.0, 0.0), (SECOND, 100.0, 0.0), (SECOND, 0.1, 0.0), (SECOND, 0.1, 0.0))
    )

    assert measurements.update(belief, 0.0) is None
    assert measurements.update(belief, 0.0) is not None
    assert measurements.update(belief, 0.0) is None
    assert asdict(measurements.counts) == {
        "received": 4,
        "accepted": 1,
        "thinned": 1,
        "rejected": 1,
        "late": 1,
    }


@pytest.mark.parametrize("is_second", [False, True])
def test_both_sources_update_at_their_own_times(is_second: bool) -> None:
    belief = start_belief(2 * SECOND, 0.0, 0.0, 0.0, 0.0, 1.0)
    early, due = PositionUpdates(), PositionUpdates()
    early.add(fixes((SECOND, 0.0, 0.0)))
    due.add(fixes((2 * SECOND, 0.1, 0.0)))
    both = BothSources(early, due) if is_second else BothSources(due, early)

    assert both.times_ns() == [SECOND, 2 * SECOND]
    assert both.update(belief, 0.0) is not None
    assert (early.counts.accepted, due.counts.accepted) == (0, 1)


_ANGLE = st.floats(-math.pi, math.pi)
_PENALTY = st.floats(0.0, 3.0)
EACH_RAD, SAME_RAD, RADIUS_M = 0.5, 0.5, 30.0


def test_car_of_fig_13_goes_straight() -> None:
    headings = np.array([0.0, -math.pi / 2])
    bearings = np.array([bearing_after(0.0, 0.0, h, 80.0, 10.0, 10.0) for h in headings])

    assert choose_option(headings, bearings, np.zeros(2)) == 0


@given(heading=_ANGLE, bearing=_ANGLE, added=_PENALTY, turn=_ANGLE)
def test_option_cost_is_invariant_to_rotation_and_mirroring(
    heading: float, bearing: float, added: float, turn: float
) -> None:
    cost = option_cost(heading, bearing, added)

    assert option_cost(heading + turn, bearing + turn, added) == pytest.approx(cost, abs=1e-9)
    assert option_cost(-heading, -bearing, added) == pytest.approx(cost, abs=1e-9)


@given(st.lists(st.tuples(_ANGLE, _ANGLE, _PENALTY), min_size=1, max_size=6))
def test_choice_is_the_first_option_of_lowest_cost(
    options: list[tuple[float, float, float]],
) -> None:
    costs = [option_cost(*option) for option in options]

    assert choose_option(*np.array(options).T) == costs.index(min(costs))


def _decided(memory: Memory, x: float, y: float, heading: float) -> Memory:
    return remember(memory, recognise(memory, x, y, RADIUS_M), x, y, heading, SAME_RAD)


def test_memory_grows_beyond_its_initial_capacity() -> None:
    memory = empty_memory()
    for i in range(200):
        memory = _decided(memory, 100.0 * i, 0.0, 0.0)
        memory = _decided(memory, 100.0 * i, 0.0, math.pi / 2)

    places = [recognise(memory, 100.0 * i, 0.0, RADIUS_M) for i in range(200)]
    assert places == list(range(200))
    assert {penalty(memory, one, math.pi / 2, SAME_RAD, EACH_RAD) for one in places} == {EACH_RAD}


def test_landmark_ahead_skips_landmarks_off_the_route_or_visited() -> None:
    behind, beside, further = (-5.0, 0.0), (30.0, 5.0), (130.0, 0.0)
    landmarks = np.array([behind, beside, further])

    def ahead(places_m: np.ndarray[tuple[int, int], np.dtype[np.float64]], *visited: bool) -> int:
        return landmark_ahead(0.0, 0.0, 100.0, 0.0, places_m, np.array(visited, np.bool_))

    assert ahead(landmarks, False, False, False) == 1
    assert ahead(landmarks, False, True, False) == NONE
    assert ahead(np.empty((0, 2))) == NONE


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
