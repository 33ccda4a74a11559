"""Scalar filter compared with hand-computed results, the printed equations, and simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.fusion.intersection_range import (
    RangeBelief,
    initialise,
    nis,
    predict,
    smooth,
    update,
)
from crosscue.fusion.range_track import (
    NOTHING,
    RangeTrack,
    Verdict,
    advance,
    measure,
    predict_without_odometry,
)
from crosscue.replay.vehicle.fusion import RangeFilter

METRES = st.floats(-200.0, 200.0)
VARIANCES = st.floats(0.01, 400.0)
FEW_EXAMPLES = settings(max_examples=60, deadline=None)


def test_eq_8_subtracts_travelled_distance_from_range() -> None:
    assert predict(RangeBelief(40.0, 2.0), 1.5, 0.1).mean_m == pytest.approx(38.5)


def test_eq_8_reversing_increases_range() -> None:
    assert predict(RangeBelief(40.0, 2.0), -1.5, 0.1).mean_m == pytest.approx(41.5)


def test_eq_9_adds_odometry_variance() -> None:
    assert predict(RangeBelief(40.0, 2.0), 1.5, 0.1).var_m2 == pytest.approx(2.1)


def test_eq_10_and_11_weight_innovation_by_gain() -> None:
    # K = 6 / (6 + 2) = 0.75; 20 + 0.75 * (24 - 20) = 23
    assert update(RangeBelief(20.0, 6.0), 24.0, 2.0).mean_m == pytest.approx(23.0)


def test_eq_12_reduces_variance_by_gain() -> None:
    assert update(RangeBelief(20.0, 6.0), 24.0, 2.0).var_m2 == pytest.approx(1.5)


def test_first_measurement_initialises_belief() -> None:
    assert initialise(31.0, 2.9) == RangeBelief(31.0, 2.9)


def test_nis_uses_sum_of_both_variances() -> None:
    assert nis(RangeBelief(20.0, 6.0), 24.0, 2.0) == pytest.approx(2.0)


@FEW_EXAMPLES
@given(METRES, VARIANCES, st.lists(st.tuples(METRES, VARIANCES), min_size=1, max_size=6))
def test_order_of_measurements_does_not_matter(
    mean_m: float, var_m2: float, seen: list[tuple[float, float]]
) -> None:
    there = back = RangeBelief(mean_m, var_m2)
    for one, other in zip(seen, reversed(seen), strict=True):
        there, back = update(there, *one), update(back, *other)

    np.testing.assert_allclose(there, back, rtol=1e-9, atol=1e-9)


@FEW_EXAMPLES
@given(METRES, VARIANCES, METRES, VARIANCES)
def test_posterior_variance_is_below_prior_and_sensor_variance(
    mean_m: float, var_m2: float, measured_m: float, sensor_var_m2: float
) -> None:
    after = update(RangeBelief(mean_m, var_m2), measured_m, sensor_var_m2)

    assert 0.0 < after.var_m2 <= min(var_m2, sensor_var_m2) * (1.0 + 1e-9)
    assert min(mean_m, measured_m) - 1e-9 <= after.mean_m <= max(mean_m, measured_m) + 1e-9


@FEW_EXAMPLES
@given(st.lists(st.tuples(METRES, VARIANCES, st.none() | METRES, VARIANCES), max_size=20))
def test_filter_steps_match_printed_equations_8_to_12(
    steps: list[tuple[float, float, float | None, float]],
) -> None:
    mean_m, var_m2 = 50.0, 9.0
    belief = RangeBelief(mean_m, var_m2)
    for travelled_m, odometry_var_m2, measured_m, sensor_var_m2 in steps:
        belief = predict(belief, travelled_m, odometry_var_m2)
        mean_m, var_m2 = mean_m - travelled_m, var_m2 + odometry_var_m2
        if measured_m is not None:
            belief = update(belief, measured_m, sensor_var_m2)
            gain = var_m2 / (var_m2 + sensor_var_m2)
            mean_m, var_m2 = mean_m + gain * (measured_m - mean_m), (1.0 - gain) * var_m2

    # The mean reaches hundreds of metres, so its rounding error is absolute.
    assert belief.mean_m == pytest.approx(mean_m, rel=1e-12, abs=1e-11)
    assert belief.var_m2 == pytest.approx(var_m2, rel=1e-11)


@pytest.mark.parametrize("sensor_var_m2", [1e-9, 2.9, 1e9])
def test_variance_matches_information_form_for_extreme_sensor_variances(
    sensor_var_m2: float,
) -> None:
    belief = RangeBelief(50.0, 400.0)
    for _ in range(50):
        belief = update(belief, 50.0, sensor_var_m2)

    assert belief.var_m2 == pytest.approx(1.0 / (1.0 / 400.0 + 50.0 / sensor_var_m2), rel=1e-9)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan])
def test_non_positive_sensor_variance_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="sensor_var_m2"):
        update(RangeBelief(30.0, 4.0), 26.0, bad)
    with pytest.raises(ValueError, match="sensor_var_m2"):
        initialise(26.0, bad)


@pytest.mark.parametrize("bad", [-1.0, math.nan])
def test_negative_odometry_variance_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="odometry_var_m2"):
        predict(RangeBelief(30.0, 4.0), 1.0, bad)


def test_filter_errors_match_reported_variance() -> None:
    rng = np.random.default_rng(seed=11)
    runs = 2000
    nees = []
    for _ in range(runs):
        truth_m = float(rng.uniform(40.0, 80.0))
        track = NOTHING
        for _ in range(30):
            truth_m -= 1.0
            track = advance(track, 1.0 + rng.normal(0.0, 0.1), 0.01, RangeFilter())
            if rng.random() < 0.5:
                seen_m = truth_m + rng.normal(0.0, 1.7)
                track, _ = measure(
                    track, seen_m, 1.7**2, RangeFilter(gate_nis=None, fade_m=0.0), 20.0
                )
        if track.belief is not None:
            nees.append((track.belief.mean_m - truth_m) ** 2 / track.belief.var_m2)

    assert len(nees) > 0.99 * runs
    assert np.mean(nees) == pytest.approx(1.0, abs=4 * math.sqrt(2 / len(nees)))


def test_implausible_measurement_is_refused_and_keeps_belief() -> None:
    before = RangeTrack(RangeBelief(40.0, 2.0))

    after, verdict = measure(before, 90.0, 2.9, RangeFilter(), 20.0)

    assert verdict is Verdict.REFUSED
    assert after.belief == before.belief


def test_consistent_measurements_replace_implausible_first_one() -> None:
    track, verdicts = NOTHING, []
    source = RangeFilter(begin_after=1, restart_after=5)
    for measured_m in (120.0, 60.0, 59.0, 61.0, 60.0, 60.0):
        track, verdict = measure(track, measured_m, 2.9, source, 20.0)
        verdicts.append(verdict)

    assert verdicts == [Verdict.BEGAN, *[Verdict.REFUSED] * 4, Verdict.RESTARTED]
    assert track.belief is not None
    assert track.belief.mean_m == pytest.approx(60.0, abs=0.5)


def test_single_measurement_starts_no_range_and_expires() -> None:
    once, verdict = measure(NOTHING, 60.0, 2.9, RangeFilter(), 20.0)
    gone = advance(advance(once, 4.0, 0.1, RangeFilter()), 2.0, 0.1, RangeFilter())

    assert verdict is Verdict.WAITS
    assert once.belief is None
    assert gone == NOTHING


def test_second_consistent_measurement_starts_range_from_both() -> None:
    independent = RangeFilter(fade_m=0.0)
    once, _ = measure(NOTHING, 60.0, 2.0, independent, 20.0)
    twice, verdict = measure(advance(once, 1.0, 0.0, independent), 61.0, 2.0, independent, 20.0)

    assert verdict is Verdict.BEGAN
    assert twice.belief == pytest.approx(RangeBelief(60.0, 1.0))


def test_contradictory_measurements_start_no_range() -> None:
    track = NOTHING
    for measured_m in (60.0, 20.0, 110.0, 45.0, 80.0):
        track, verdict = measure(track, measured_m, 2.9, RangeFilter(), 20.0)
        assert verdict is Verdict.WAITS

    assert track.belief is None


def test_pending_measurement_is_kept_at_standstill_and_widens_without_odometry() -> None:
    once, _ = measure(NOTHING, 60.0, 2.9, RangeFilter(), 20.0)
    stood = advance(once, 0.0, 0.0, RangeFilter())
    blind = predict_without_odometry(once, 3.0, RangeFilter())

    assert stood.rival == once.rival
    assert blind.rival is not None
    assert math.sqrt(blind.rival.var_m2) == pytest.approx(math.sqrt(2.9) + 3.0)
    assert predict_without_odometry(blind, 3.0, RangeFilter()) == NOTHING


def test_contradictory_implausible_measurements_never_replace_belief() -> None:
    track = RangeTrack(RangeBelief(50.0, 2.0))
    for measured_m in (100.0, 20.0, 130.0, 10.0, 90.0, 140.0, 70.0):
        track, verdict = measure(track, measured_m, 2.9, RangeFilter(restart_after=2), 20.0)
        assert verdict is Verdict.REFUSED

    assert track.belief == RangeBelief(50.0, 2.0)


def test_sign_of_next_intersection_does_not_replace_near_range() -> None:
    track = RangeTrack(RangeBelief(8.0, 2.0))
    for _ in range(20):
        track, verdict = measure(track, 70.0, 2.9, RangeFilter(), 20.0)
        assert verdict is Verdict.REFUSED

    assert track.belief == RangeBelief(8.0, 2.0)


def test_range_with_excessive_variance_is_dropped() -> None:
    assert advance(RangeTrack(RangeBelief(50.0, 399.0)), 0.0, 2.0, RangeFilter()) == NOTHING


def test_measurement_from_same_place_adds_no_information_with_fading_errors() -> None:
    fading = RangeFilter(fade_m=2.0, begin_after=1)
    track, _ = measure(NOTHING, 40.0, 2.9, fading, 20.0)

    again, verdict = measure(track, 42.0, 2.9, fading, 20.0)
    far, _ = measure(advance(track, 30.0, 0.0, fading), 12.0, 2.9, fading, 20.0)

    assert verdict is Verdict.TAKEN
    assert again.belief == pytest.approx(RangeBelief(40.0, 2.9))
    assert far.belief == pytest.approx(RangeBelief(11.0, 1.45))


def test_filter_errors_match_variance_with_distance_correlated_noise() -> None:
    rng = np.random.default_rng(3)
    fade_m, sd_m, runs = 3.0, 1.7, 600
    rho = math.exp(-1.0 / fade_m)
    nees: dict[float, list[float]] = {fade_m: [], 0.0: []}
    for _ in range(runs):
        tracks = dict.fromkeys(nees, NOTHING)
        truth_m, error_m = 70.0, float(rng.normal(0.0, sd_m))
        for _ in range(40):
            truth_m -= 1.0
            error_m = rho * error_m + math.sqrt(1.0 - rho**2) * float(rng.normal(0.0, sd_m))
            for fade in tracks:
                filters = RangeFilter(gate_nis=None, fade_m=fade)
                gone = advance(tracks[fade], 1.0, 0.0, filters)
                tracks[fade], _ = measure(gone, truth_m + error_m, sd_m**2, filters, 20.0)
        for fade, track in tracks.items():
            assert track.belief is not None
            nees[fade].append((track.belief.mean_m - truth_m) ** 2 / track.belief.var_m2)

    assert np.mean(nees[fade_m]) == pytest.approx(1.0, abs=0.15)
    assert np.mean(nees[0.0]) > 3.0


def test_smoother_equals_least_squares_over_all_measurements() -> None:
    travelled_m, way_var_m2 = [2.0, 3.0, 1.0], [0.1, 0.2, 0.05]
    measured_m, sensor_var_m2 = [40.5, None, 34.2, 34.1], 2.0
    belief = initialise(40.5, sensor_var_m2)
    filtered = [belief]
    for way_m, way_m2, measured in zip(travelled_m, way_var_m2, measured_m[1:], strict=True):
        belief = predict(belief, way_m, way_m2)
        belief = belief if measured is None else update(belief, measured, sensor_var_m2)
        filtered.append(belief)
    rows, right = [], []
    for i, measured in enumerate(measured_m):
        if measured is not None:
            rows.append(np.eye(4)[i] / np.sqrt(sensor_var_m2))
            right.append(measured / np.sqrt(sensor_var_m2))
    for i, (way_m, way_m2) in enumerate(zip(travelled_m, way_var_m2, strict=True)):
        rows.append((np.eye(4)[i + 1] - np.eye(4)[i]) / np.sqrt(way_m2))
        right.append(-way_m / np.sqrt(way_m2))
    cov = np.linalg.inv(np.array(rows).T @ np.array(rows))

    found = smooth(filtered, travelled_m, way_var_m2)

    np.testing.assert_allclose(
        [one.mean_m for one in found], cov @ np.array(rows).T @ np.array(right), rtol=1e-9
    )
    np.testing.assert_allclose([one.var_m2 for one in found], np.diagonal(cov), rtol=1e-9)
