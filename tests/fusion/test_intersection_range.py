"""Scalar filter compared with hand-computed results, the printed equations, and simulation."""

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
    smooth_ranges,
    update,
)
from crosscue.fusion.range_track import NOTHING, advance_range, fuse_range
from crosscue.replay.vehicle.fusion import RangeFilter

METRES = st.floats(-200.0, 200.0)
VARIANCES = st.floats(0.01, 400.0)
FEW_EXAMPLES = settings(max_examples=60, deadline=None)


def test_first_measurement_initialises_belief() -> None:
    assert initialise(31.0, 0.5) == RangeBelief(31.0, 0.5)


def test_nis_uses_sum_of_both_variances() -> None:
    assert nis(RangeBelief(20.0, 6.0), 24.0, 2.0) == pytest.approx(2.0)


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
    refusal = rf"^sensor_var_m2: expected > 0, got {bad}$"
    with pytest.raises(ValueError, match=refusal):
        update(RangeBelief(30.0, 4.0), 26.0, bad)
    with pytest.raises(ValueError, match=refusal):
        initialise(26.0, bad)


@pytest.mark.parametrize("bad", [-1.0, math.nan])
def test_negative_odometry_variance_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match=rf"^odometry_var_m2: expected >= 0, got {bad}$"):
        predict(RangeBelief(30.0, 4.0), 1.0, bad)


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
                gone = advance_range(tracks[fade], 1.0, 0.0, filters)
                tracks[fade], _ = fuse_range(gone, truth_m + error_m, sd_m**2, filters, 20.0)
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

    found = smooth_ranges(filtered, travelled_m, way_var_m2)

    np.testing.assert_allclose(
        [one.mean_m for one in found], cov @ np.array(rows).T @ np.array(right), rtol=1e-9
    )
    np.testing.assert_allclose([one.var_m2 for one in found], np.diagonal(cov), rtol=1e-9)
