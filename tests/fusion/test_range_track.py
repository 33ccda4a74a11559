"""Ranges along the road: a scalar filter, and the track of a range."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.fusion.intersection_range import (
    RangeBelief,
    initialise,
    predict,
    smooth_ranges,
    update,
)
from crosscue.fusion.range_track import (
    NOTHING,
    RangeTrack,
    Verdict,
    advance_range,
    follow,
    fuse_range,
    predict_without_odometry,
)
from crosscue.replay.vehicle.fusion import RangeFilter

METRES = st.floats(-200.0, 200.0)
VARIANCES = st.floats(0.01, 400.0)
FEW_EXAMPLES = settings(max_examples=60, deadline=None)


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


SETTINGS = RangeFilter()
# One first measurement, 2 m ago.
PENDING = RangeTrack(None, RangeBelief(60.0, 2.0), 1, 2.0)
RIVALLED = RangeTrack(RangeBelief(50.0, 4.0), RangeBelief(80.0, 9.0), 2, 1.0)


def belief(track: RangeTrack) -> RangeBelief:
    assert track.belief is not None
    return track.belief


def test_belief_is_dropped_above_maximum_sd() -> None:
    """The maximum is 20 m: 399 + 1 = 20^2 is kept, 399 + 1.001 is not."""
    track = RangeTrack(RangeBelief(50.0, 399.0))

    assert advance_range(track, 2.0, 1.0, SETTINGS) == RangeTrack(
        RangeBelief(48.0, 400.0), unseen_m=2.0
    )
    assert advance_range(track, 2.0, 1.001, SETTINGS) == NOTHING


def test_first_measurement_is_forgotten_beyond_five_metres() -> None:
    """2 + 3 = 5 m is not beyond; 2 + 3.001 m is."""
    after = RangeTrack(None, RangeBelief(57.0, 2.1), 1, 5.0)

    assert advance_range(PENDING, 3.0, 0.1, SETTINGS) == after
    assert advance_range(PENDING, 3.001, 0.1, SETTINGS) == NOTHING


def test_unknown_distance_adds_to_sd_of_belief() -> None:
    """(2 + 3)^2 = 25 for the belief; the rival's variance grows by the same 21."""
    wide = RangeTrack(RangeBelief(50.0, 25.0), RangeBelief(80.0, 30.0), 2, 4.0)

    assert predict_without_odometry(RIVALLED, 3.0, SETTINGS) == wide
    first = RangeTrack(None, RangeBelief(60.0, 4.0), 1, 1.0)
    after = RangeTrack(None, RangeBelief(60.0, 25.0), 1, 4.0)
    assert predict_without_odometry(first, 3.0, SETTINGS) == after
    assert predict_without_odometry(NOTHING, 3.0, SETTINGS) == NOTHING


@pytest.mark.parametrize(
    ("unseen_m", "fade_m", "sensor_var_m2"),
    [(math.log(3.0), 1.0, 1.0), (2.0 * math.log(3.0), 2.0, 1.0), (5.0, 0.0, 2.0)],
)
def test_measurement_counts_as_independent_fraction(
    unseen_m: float, fade_m: float, sensor_var_m2: float
) -> None:
    """A correlation of 1/3 is worth (1 - 1/3) / (1 + 1/3) = 1/2, which doubles the variance to 2.

    Then K = 6 / (6 + 2) = 3/4: 20 + 3/4 (24 - 20) = 23 and 6 (1 - 3/4) = 1.5. With no fade, a
    measurement is independent.
    """
    settings = RangeFilter(fade_m=fade_m, begin_after=2)
    near = RangeBelief(20.0, 6.0)

    taken, verdict = fuse_range(
        RangeTrack(near, None, 3, unseen_m), 24.0, sensor_var_m2, settings, 0
    )
    began, first = fuse_range(RangeTrack(None, near, 1, unseen_m), 24.0, sensor_var_m2, settings, 0)

    assert (verdict, first) == (Verdict.TAKEN, Verdict.BEGAN)
    for track in (taken, began):
        assert track == RangeTrack(track.belief)
        assert track.belief == pytest.approx((23.0, 1.5))


def test_measurement_at_same_place_changes_nothing() -> None:
    track = RangeTrack(RangeBelief(40.0, 2.9))

    again, verdict = fuse_range(track, 42.0, 2.9, SETTINGS, 20.0)

    assert verdict is Verdict.TAKEN
    assert again.belief == pytest.approx(track.belief)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_gate_rejects_normalised_innovation_above_sixteen(sign: float) -> None:
    """8^2 / (3 + 1) = 16 is inside; 8.001^2 / 4 is not."""
    track = RangeTrack(RangeBelief(40.0, 3.0), unseen_m=7.0)
    ungated = RangeFilter(gate_nis=None)
    far_m = 40.0 + sign * 8.001

    assert fuse_range(track, 40.0 + sign * 8.0, 1.0, SETTINGS, 20.0)[1] is Verdict.TAKEN
    assert fuse_range(track, far_m, 1.0, ungated, 20.0)[1] is Verdict.TAKEN
    assert follow(track, 40.0 + sign * 8.0, 1.0, 1.0, SETTINGS)[1] is Verdict.TAKEN
    assert follow(track, far_m, 1.0, 1.0, ungated)[1] is Verdict.TAKEN
    restarted = RangeTrack(RangeBelief(far_m, 1.0))
    assert follow(track, far_m, 1.0, 1.0, SETTINGS) == (restarted, Verdict.RESTARTED)
    after = RangeTrack(track.belief, RangeBelief(far_m, 1.0), 1, 7.0)
    assert fuse_range(track, far_m, 1.0, SETTINGS, 20.0) == (after, Verdict.REFUSED)


@pytest.mark.parametrize(
    ("rival", "seen", "mean_m", "after", "verdict"),
    [
        # It agrees: 80 + 1/2 (84 - 80), 2 (1 - 1/2), regardless of the fade.
        (RangeBelief(80.0, 2.0), 3, 20.1, (RangeBelief(82.0, 1.0), 4), Verdict.REFUSED),
        (RangeBelief(80.0, 2.0), 4, 20.1, (RangeBelief(82.0, 1.0), 0), Verdict.RESTARTED),
        # Within 20 m, it belongs to the next intersection.
        (RangeBelief(80.0, 2.0), 4, 20.0, (RangeBelief(82.0, 1.0), 5), Verdict.REFUSED),
        # 84 and 120 disagree, so the count begins again.
        (RangeBelief(120.0, 2.0), 4, 20.1, (RangeBelief(84.0, 2.0), 1), Verdict.REFUSED),
        # Without a belief, the second measurement begins; a contradictory one waits.
        (RangeBelief(80.0, 2.0), 1, None, (RangeBelief(82.0, 1.0), 0), Verdict.BEGAN),
        (RangeBelief(120.0, 2.0), 1, None, (RangeBelief(84.0, 2.0), 1), Verdict.WAITS),
        (None, 0, None, (RangeBelief(84.0, 2.0), 1), Verdict.WAITS),
    ],
)
def test_measurements_that_agree_with_each_other_begin_or_replace_range(
    rival: RangeBelief | None,
    seen: int,
    mean_m: float | None,
    after: tuple[RangeBelief, int],
    verdict: Verdict,
) -> None:
    """The measurement is 84 m with variance 2; a range begins with two and is replaced by five."""
    before = None if mean_m is None else RangeBelief(mean_m, 1.0)
    # Forty metres are many fading lengths, so a first measurement counts fully.
    track, found = fuse_range(RangeTrack(before, rival, seen, 40.0), 84.0, 2.0, SETTINGS, 20.0)

    assert found is verdict
    if verdict in (Verdict.BEGAN, Verdict.RESTARTED):
        assert track == RangeTrack(after[0])
    else:
        unseen_m = 0.0 if before is None else 40.0
        assert track == RangeTrack(before, *after, unseen_m)


def test_rival_counts_fully_at_standstill_unlike_first_measurements() -> None:
    """At the place of the last one, only a rejected measurement has its full weight."""
    rival = RangeBelief(80.0, 2.0)

    track, _ = fuse_range(RangeTrack(RangeBelief(40.0, 1.0), rival, 1), 84.0, 2.0, SETTINGS, 20.0)
    first, _ = fuse_range(RangeTrack(None, rival, 1), 84.0, 2.0, SETTINGS, 20.0)

    assert track.rival == RangeBelief(82.0, 1.0)
    assert first.belief == pytest.approx(rival)


def test_tracker_range_begins_or_is_adopted_at_once_without_take_up_distance() -> None:
    at_once = SETTINGS.model_copy(update={"take_up_m": 0.0})
    adopted = RangeTrack(RangeBelief(44.0, 4.0))

    assert follow(NOTHING, 44.0, 4.0, 0.0, SETTINGS) == (adopted, Verdict.BEGAN)
    assert follow(RangeTrack(RangeBelief(50.0, 9.0)), 44.0, 4.0, 0.0, at_once)[0] == adopted


@pytest.mark.parametrize("correction_m", [-9.0, 5.0, 9.9])
def test_correction_within_take_up_distance_never_increases_range(correction_m: float) -> None:
    track, _ = follow(NOTHING, 80.0, 100.0, 0.0, SETTINGS)
    ranges = [belief(track).mean_m]
    for i in range(1, 120):
        way_m = (0.0, 0.3, 1.1)[i % 3]
        gone_m = sum((0.0, 0.3, 1.1)[k % 3] for k in range(1, i + 1))
        track = advance_range(track, way_m, 0.0, SETTINGS)
        track, _ = follow(track, 80.0 + correction_m - gone_m, 100.0, way_m, SETTINGS)
        ranges.append(belief(track).mean_m)

    assert (np.diff(ranges) <= 1e-12).all()
    assert ranges[-1] == pytest.approx(80.0 + correction_m - gone_m, abs=0.1)


@pytest.mark.parametrize("take_up_m", [0.0, 3.0, 10.0, 40.0])
def test_followed_range_errors_match_reported_variance(take_up_m: float) -> None:
    """The tracker's range is the mean of all measurements so far, so later ones are better."""
    rng = np.random.default_rng(5)
    settings = SETTINGS.model_copy(update={"take_up_m": take_up_m, "gate_nis": None})
    squares = []
    for _ in range(2000):
        true_m, sum_m, track = 80.0, 0.0, NOTHING
        for n in range(1, 31):
            if n > 1:
                true_m -= 1.0
                track = advance_range(track, 1.0, 0.0, settings)
            sum_m += rng.normal(0.0, 6.0)
            track, _ = follow(track, true_m + sum_m / n, 36.0 / n, 1.0, settings)
        squares.append((belief(track).mean_m - true_m) ** 2 / belief(track).var_m2)

    assert float(np.mean(squares)) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 2000))
