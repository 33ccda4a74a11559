"""Tests of following a tracker's range without counting it twice and without jumps."""

import numpy as np
import pytest

from crosscue.fusion.intersection_range import RangeBelief
from crosscue.fusion.range_track import NOTHING, RangeTrack, Verdict, advance, follow
from crosscue.replay.vehicle.fusion import RangeFilter

SETTINGS = RangeFilter()


def belief(track: RangeTrack) -> RangeBelief:
    assert track.belief is not None
    return track.belief


def test_first_range_is_adopted_and_kept_while_car_stands() -> None:
    track, began = follow(NOTHING, 50.0, 9.0, 0.0, SETTINGS)
    again, taken = follow(track, 44.0, 4.0, 0.0, SETTINGS)

    assert (began, taken) == (Verdict.BEGAN, Verdict.TAKEN)
    assert belief(track) == belief(again) == RangeBelief(50.0, 9.0)


def test_zero_take_up_distance_adopts_tracker_range_at_once() -> None:
    settings = SETTINGS.model_copy(update={"take_up_m": 0.0})
    track, _ = follow(RangeTrack(RangeBelief(50.0, 9.0)), 44.0, 4.0, 1.0, settings)

    assert belief(track) == RangeBelief(44.0, 4.0)


@pytest.mark.parametrize("correction_m", [-9.0, 5.0, 9.9])
def test_correction_within_take_up_distance_never_increases_range(correction_m: float) -> None:
    track, _ = follow(NOTHING, 80.0, 100.0, 0.0, SETTINGS)
    ranges = [belief(track).mean_m]
    for i in range(1, 120):
        way_m = (0.0, 0.3, 1.1)[i % 3]
        gone_m = sum((0.0, 0.3, 1.1)[k % 3] for k in range(1, i + 1))
        track = advance(track, way_m, 0.0, SETTINGS)
        track, _ = follow(track, 80.0 + correction_m - gone_m, 100.0, way_m, SETTINGS)
        ranges.append(belief(track).mean_m)

    assert (np.diff(ranges) <= 1e-12).all()
    assert ranges[-1] == pytest.approx(80.0 + correction_m - gone_m, abs=0.1)


def test_inconsistent_range_replaces_belief() -> None:
    track, verdict = follow(RangeTrack(RangeBelief(50.0, 1.0)), 80.0, 1.0, 0.1, SETTINGS)

    assert verdict is Verdict.RESTARTED
    assert belief(track) == RangeBelief(80.0, 1.0)


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
                track = advance(track, 1.0, 0.0, settings)
            sum_m += rng.normal(0.0, 6.0)
            track, _ = follow(track, true_m + sum_m / n, 36.0 / n, 1.0, settings)
        squares.append((belief(track).mean_m - true_m) ** 2 / belief(track).var_m2)

    assert float(np.mean(squares)) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 2000))
