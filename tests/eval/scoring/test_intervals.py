"""Intervals over drives and places, changes over versions, and full detection by threshold."""

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import stdtrit

from crosscue.datasets.truth.truth import Origin, Truth
from crosscue.datasets.truth.tum import planar, write_tum
from crosscue.eval.scoring import change_points as module
from crosscue.eval.scoring.change_points import FALSE_ALARMS, Results, change_points
from crosscue.eval.scoring.columns import NONE
from crosscue.eval.scoring.drives import pool_scores, score_drive
from crosscue.eval.scoring.intervals import (
    MIN_CLUSTERS,
    fraction,
    fraction_by_cluster,
    mean,
    mean_by_cluster,
)
from crosscue.eval.scoring.places import group_drives, group_places, places_of
from crosscue.eval.scoring.scene.detection import CONFIRM_FRAMES, held
from crosscue.eval.scoring.scene.trade import Reached, reached, trade_off
from crosscue.eval.scoring.truth import DriveTruth, read_scored_truth
from crosscue.eval.studies.intervals import fraction_of, mean_of, range_at, ratio_of, ratio_of_means
from crosscue.replay.columns import Int64s
from support.scoring import approach, good_tables, good_truth, truth_folder

TIMES = 800
# Three standard deviations of a coverage of 95 % in ``TIMES`` trials.
SLACK = 0.023


def sizes(rng: np.random.Generator, clusters: int, *, equal: bool) -> Int64s:
    return np.full(clusters, 20) if equal else rng.integers(5, 60, clusters)


@pytest.mark.parametrize("equal", [True, False])
@pytest.mark.parametrize("clusters", [6, 8, 30])
def test_intervals_of_means_have_stated_coverage(clusters: int, equal: bool) -> None:
    rng = np.random.default_rng(clusters)
    covered = 0
    for _ in range(TIMES):
        rows = sizes(rng, clusters, equal=equal)
        which = np.repeat(np.arange(clusters), rows)
        values = rng.normal(0.0, 1.0, clusters)[which] + rng.normal(0.0, 1.0, len(which))
        low, high = mean_by_cluster(values, which)
        covered += low <= 0.0 <= high

    assert covered / TIMES > 0.95 - SLACK


def coverage(clusters: int, fraction: float, correlation: float) -> float:
    rng = np.random.default_rng(clusters)
    covered = 0
    for _ in range(TIMES):
        rows = sizes(rng, clusters, equal=False)
        rest = 1.0 / correlation - 1.0
        which = np.repeat(np.arange(clusters), rows)
        is_right = (
            rng.random(len(which))
            < rng.beta(fraction * rest, (1.0 - fraction) * rest, clusters)[which]
        )
        low, high = fraction_by_cluster(is_right, which)
        covered += low <= fraction <= high
    return covered / TIMES


@pytest.mark.parametrize("correlation", [0.05, 0.2])
@pytest.mark.parametrize("fraction", [0.5, 0.8, 0.95])
@pytest.mark.parametrize("clusters", [6, 8, 12, 20, 30, 60])
def test_intervals_of_fractions_have_nearly_stated_coverage(
    clusters: int, fraction: float, correlation: float
) -> None:
    """From 93 to 97 %, plus the s.d. of 800 trials, 0.6 %; over six or eight clusters, to 98 %."""
    covered = coverage(clusters, fraction, correlation)
    assert 0.93 <= covered <= (0.97 if clusters > 8 else 0.98) + SLACK / 3.0


def test_six_clusters_cover_less_where_their_rows_are_strongly_correlated() -> None:
    """So few hardly show the correlation; a larger quantile would cover too much elsewhere."""
    assert 0.88 < coverage(6, 0.8, 0.6) < 0.93 < coverage(6, 0.8, 0.05)


def test_few_clusters_with_most_errors_have_fewer_degrees_of_freedom() -> None:
    """Errors in one of eight clusters of ten: effects of 7 and -1 (seven times) have kurtosis 43/7.

    Without bias it is 3 + 7/30 * (9 * 22/7 + 6) = 11, so 2 * 8 / 10 = 1.6 degrees. Seven clusters
    have six.
    """
    drives = np.repeat(np.arange(8), 10)
    right = np.ones(80, np.bool_)
    right[:5] = False

    z = float(stdtrit(1.6, 0.975))
    p, of = 75 / 80, 15.0 / 16.0 / 16.0 / (0.5**2 / 8 / 8)
    low, high = fraction_by_cluster(right, drives)
    middle, half = p + 0.5 * z * z / of, z * np.sqrt(p * (1.0 - p) / of + 0.25 * (z / of) ** 2)
    assert (low, high) == pytest.approx(
        ((middle - half) / (1.0 + z * z / of), (middle + half) / (1.0 + z * z / of))
    )
    seven = fraction_by_cluster(right[:70], drives[:70])
    assert seven.high - seven.low < high - low


def test_interval_with_one_row_per_cluster_is_students_t() -> None:
    values = np.random.default_rng(3).normal(5.0, 2.0, 9)
    low, high = mean_by_cluster(values, np.arange(9))
    of_study = mean_of(values)

    assert high - low == pytest.approx(2 * 2.306004 * values.std(ddof=1) / 3.0, rel=1e-6)
    assert (of_study.low, of_study.high) == pytest.approx((low, high), rel=1e-12)


def test_intervals_stay_within_bounds_and_need_six_clusters() -> None:
    right, drives = np.ones(600, np.bool_), np.repeat(np.arange(6), 100)

    low, high = fraction_by_cluster(right, drives)
    assert 0.5 < low < 0.7
    assert high == 1.0
    assert fraction_by_cluster(~right, drives) == pytest.approx((0.0, 1.0 - low))
    assert np.isnan(fraction_by_cluster(right[:500], drives[:500])).all()
    assert np.isnan(mean_by_cluster(np.ones(500), drives[:500])).all()
    assert np.isnan(mean_of(np.ones(5)).low)
    assert np.isnan(range_at(np.arange(5.0), np.ones(5), 0.8).low)
    assert fraction_of(8, 10).value == 0.8
    assert fraction_of(0, 0).low == 0.0


def test_ratio_interval_covers_and_equals_ratio_of_means_over_all_drives() -> None:
    rng = np.random.default_rng(2)
    covered = 0
    for _ in range(TIMES):
        bottom = rng.gamma(5.0, 1.0, 20)
        top = bottom * rng.gamma(20.0, 1.3 / 20.0, 20)
        found = ratio_of(top, bottom)
        covered += found.low <= 1.3 <= found.high
        every = np.ones(20)
        assert ratio_of_means(top, every, bottom, every) == pytest.approx(found, rel=1e-9)

    assert covered / TIMES > 0.92


TIMES_PLACES = 400


def test_place_of_the_truth_comes_before_names_of_intersections(tmp_path: Path) -> None:
    named = read_scored_truth(truth_folder(tmp_path / "a"), "a")
    placed = read_scored_truth(truth_folder(tmp_path / "b", place="Elm Street"), "b")

    intersection = named.truth.approaches[0].intersection
    assert named.places == {NONE: intersection, 0: intersection}
    assert set(placed.places.values()) == {"Elm Street"}


def test_positions_within_50_m_are_one_place(tmp_path: Path) -> None:
    def truth_at(east_m: float) -> Truth:
        name = f"{east_m:g}.tum"
        t_ns = np.arange(5) * 10**9
        x_m = east_m + np.linspace(-30.0, 0.0, 5)
        write_tum(tmp_path / name, planar(t_ns, x_m, np.zeros(5), np.zeros(5)), "made up")
        one = approach().model_copy(update={"start_ns": 0, "enter_ns": 4 * 10**9})
        origin = Origin(latitude_deg=52.5, longitude_deg=13.4, altitude_m=40.0)
        return Truth(
            version=1, start_ns=0, end_ns=5 * 10**9, pose=name, origin=origin, approaches=(one,)
        )

    found = [places_of(truth_at(east_m), tmp_path) for east_m in (0.0, 45.0, 90.0, 200.0)]
    first = found[0][0]
    assert first == found[0][NONE]
    assert first == "geo:52.500000,13.400000"
    # The second connects the first and the third, which are 90 m apart.
    assert group_places([one[0] for one in found]).tolist() == [0, 0, 0, 1]
    assert group_places([found[0][0], found[2][0]]).tolist() == [0, 1]


def test_drives_that_share_a_place_are_one_group() -> None:
    drives = [["a"], ["b"], ["b", "c"], ["d"], ["c"]]

    assert group_drives(drives).tolist() == [0, 1, 1, 2, 1]
    assert group_drives([]).tolist() == []


def test_drives_to_one_intersection_have_no_interval_of_scores() -> None:
    def scored(names: list[str]) -> float:
        drives = []
        for number, name in enumerate(names):
            truth = good_truth()
            placed = DriveTruth(f"drive {number}", truth.truth, truth.ranges, {0: name, NONE: name})
            drives.append(score_drive(good_tables(), placed))
        found = pool_scores(drives)
        assert found.approaches is not None
        precision = found.cues["stop_sign"].precision
        brier = found.belief["left"].brier
        clusters = {precision.clusters, brier.clusters, found.approaches.detected_m.clusters}
        assert clusters == {len(set(names))}
        return brier.low

    assert math.isnan(scored(["A"] * 8))
    assert math.isfinite(scored([f"{i % MIN_CLUSTERS}" for i in range(8)]))


@pytest.mark.parametrize("places", [6, 8])
def test_intervals_over_places_cover_what_intervals_over_drives_miss(places: int) -> None:
    """Four drives per place; as drives, 20 of 5 places covered 81 to 83 %."""
    rng = np.random.default_rng(places)
    at = np.repeat(np.arange(places), 4)
    right = {"places": 0, "drives": 0, "fraction": 0}
    for _ in range(TIMES_PLACES):
        values = rng.normal(0.0, 1.0, places)[at] + rng.normal(0.0, 0.7, len(at))
        for name, clusters in (("places", at), ("drives", np.arange(len(at)))):
            found = mean(values, clusters)
            right[name] += found.low <= 0.0 <= found.high
        level = rng.beta(8.0, 2.0, places)[at]
        rows = np.repeat(np.arange(len(at)), 10)
        found_fraction = fraction(rng.random(len(rows)) < level[rows], at[rows])
        low, high = found_fraction.clusters_low, found_fraction.clusters_high
        right["fraction"] += low <= 0.8 <= high

    assert right["drives"] / TIMES_PLACES < 0.85
    assert right["places"] / TIMES_PLACES > 0.95 - 3.0 * math.sqrt(0.95 * 0.05 / TIMES_PLACES)
    assert right["fraction"] / TIMES_PLACES > 0.93 - 2.0 * math.sqrt(0.95 * 0.05 / TIMES_PLACES)


DRIVES, VERSIONS = 8, 6


def history(
    rng: np.random.Generator, steps: dict[int, float], drives: int = DRIVES
) -> NDArray[np.float64]:
    """Generate values of drives with different levels, noise, and steps at some versions."""
    level = rng.normal(0.0, 1.0, (drives, 1))
    values = level + rng.normal(0.0, 0.1, (drives, VERSIONS))
    for at, step in steps.items():
        values[:, at:] += step
    return values


def results(*values: NDArray[np.float64]) -> dict[str, Results]:
    return {
        str(i): Results(one, np.ones(len(one)), np.arange(len(one))) for i, one in enumerate(values)
    }


def places(found: dict[str, Results]) -> list[list[int]]:
    return [[point.at for point in points] for points in change_points(found).values()]


def test_steps_are_found_at_their_versions() -> None:
    right = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        steps: tuple[dict[int, float], ...] = ({3: 0.5}, {1: 0.5, 4: -0.5}, {})
        found = places(results(*(history(rng, one) for one in steps)))
        assert {*found[0]} >= {3}
        assert {*found[1]} >= {1, 4}
        right += found == [[3], [1, 4], []]

    # Each of two further rounds finds a false change in 5 % of cases: 18 are right on average.
    assert right >= 15


def test_false_alarm_rate_is_as_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SHUFFLES", 100)
    rng = np.random.default_rng(2)
    times = 300
    alarms = sum(any(places(results(*(history(rng, {}) for _ in range(3))))) for _ in range(times))

    assert alarms / times <= FALSE_ALARMS + 2.0 * math.sqrt(FALSE_ALARMS / times)


def test_change_points_do_not_depend_on_order_of_drives_or_scale() -> None:
    values = history(np.random.default_rng(3), {2: 0.3})
    points = change_points(results(values))["0"]

    assert points[0].by == pytest.approx(0.3, abs=0.15)
    # Another unit is another scale; the mirrored history has the mirrored change.
    (scaled,) = change_points(results(1000.0 * values + 5.0))["0"]
    assert (scaled.at, scaled.p) == (points[0].at, points[0].p)
    assert scaled.by == pytest.approx(1000.0 * points[0].by)
    assert places(results(values[::-1])) == [[2]]
    assert places(results(values[:, ::-1])) == [[VERSIONS - 2]]


def test_constant_missing_and_single_version_results_have_no_change() -> None:
    assert places(results(np.ones((DRIVES, VERSIONS)))) == [[]]
    assert places(results(np.ones((DRIVES, 1)))) == [[]]
    assert places(results(np.full((DRIVES, VERSIONS), np.nan))) == [[]]
    assert change_points({}) == {}


def test_drives_of_one_place_count_once_and_are_shuffled_alike() -> None:
    rng = np.random.default_rng(6)
    values = history(rng, {3: 1.0}, drives=12)

    def at(places: int) -> list[int]:
        where = np.arange(12) % places
        (found,) = change_points({"a": Results(values, np.ones(12), where)}).values()
        return [point.at for point in found]

    assert at(12) == at(MIN_CLUSTERS) == [3]
    assert at(MIN_CLUSTERS - 1) == []
    alike = module._shuffled(values, np.ones(values.shape, np.bool_), np.zeros(12, np.int64))
    first = np.array([[np.flatnonzero(values[d] == one)[0] for one in alike[7, d]] for d in (0, 5)])
    assert (first[0] == first[1]).all()


PRESENT, ABSENT = ("intersection", "left"), ("right",)


@pytest.mark.parametrize("seed", range(5))
def test_thresholds_agree_with_detection_at_each_threshold(seed: int) -> None:
    rng = np.random.default_rng(seed)
    features = {name: rng.random(20) for name in (*PRESENT, *ABSENT)}
    sure = rng.random(20) < 0.3
    found = reached(features, PRESENT, ABSENT, sure)

    assert found.full is not None
    so_far = np.maximum.accumulate(np.max([*features.values()], axis=0))
    for threshold in np.linspace(0.0, 1.0, 41):
        is_sure = (features["intersection"] > threshold) | (sure & (so_far > threshold))
        above = is_sure & (features["left"] > threshold)
        is_full = bool(held(above, CONFIRM_FRAMES).any())
        # Where presence is established, the intersection counts as what established it.
        assert is_full == (found.full > threshold)
        assert bool((features["right"] > threshold).any()) == (found.false[0] > threshold)


def test_established_presence_counts_alike_where_it_is_right_and_where_it_is_wrong() -> None:
    rising = {"intersection": np.linspace(0.1, 0.6, 6), "left": np.array([0, 0, 0.9, 0, 0, 0])}
    sure = np.arange(6) >= 3

    assert reached(rising, ("intersection",), (), sure) == Reached(0.9, ())
    assert reached(rising, (), ("intersection",), sure) == Reached(None, (0.9,))
    assert reached(rising, (), ("intersection",), np.zeros(6, np.bool_)) == Reached(None, (0.6,))


def test_each_rate_has_the_lowest_threshold_that_keeps_to_it() -> None:
    some = [Reached(0.1 * i, (0.1 * i - 0.05,)) for i in range(1, 11)]
    some += [Reached(None, (0.02,))] * 10
    none, half, all_ = trade_off(some, np.arange(20), (0.0, 0.25, 2.0))

    assert (none.false_features, half.false_features, all_.false_features) == (0.0, 0.25, 1.0)
    assert none.threshold == pytest.approx(0.95)
    assert none.full.value == pytest.approx(0.1)
    assert half.full.value == pytest.approx(0.6)
    assert all_.full.value == pytest.approx(1.0)
    assert half.full.of == 10


def test_belief_that_ranks_equally_has_the_same_curve() -> None:
    """Only the ranking counts: raising a threshold is no merit of the belief."""
    rng = np.random.default_rng(1)
    plain = [Reached(full, (p,)) for full, p in rng.random((40, 2)).tolist()]
    bold = [Reached((one.full or 0.0) ** 0.1, (one.false[0] ** 0.1,)) for one in plain]

    for one, other in zip(*(trade_off(x, np.arange(40)) for x in (plain, bold)), strict=True):
        assert (one.full, one.false_features) == (other.full, other.false_features)


def test_short_or_missing_belief_is_never_full() -> None:
    assert reached({}, PRESENT, ABSENT, np.zeros(0, np.bool_)) == Reached(-1.0, (0.0,))
    assert reached({"left": np.ones(9)}, PRESENT, ABSENT, np.zeros(9, np.bool_)).full == -1.0
    assert reached({"right": np.ones(1)}, (), ABSENT, np.zeros(1, np.bool_)).full is None
