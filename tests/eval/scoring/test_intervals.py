"""Intervals over clusters: coverage in simulations, and limits."""

import numpy as np
import pytest
from scipy.special import stdtrit

from crosscue.eval.scoring.intervals import fraction_by_cluster, mean_by_cluster
from crosscue.eval.studies.intervals import mean_of, range_at, ratio_of, ratio_of_means
from crosscue.replay.columns import Int64s

TIMES = 800
# Three standard deviations of a coverage of 95 % in ``TIMES`` trials.
SLACK = 0.023


def sizes(rng: np.random.Generator, clusters: int, *, equal: bool) -> Int64s:
    return np.full(clusters, 20) if equal else rng.integers(5, 60, clusters)


@pytest.mark.parametrize("equal", [True, False])
@pytest.mark.parametrize("clusters", [4, 5, 8, 30])
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
@pytest.mark.parametrize("clusters", [4, 5, 8, 12, 20, 30, 60])
def test_intervals_of_fractions_have_nearly_stated_coverage(
    clusters: int, fraction: float, correlation: float
) -> None:
    """At least 93 %, and from twelve clusters on at most 97 %, plus the s.d. of 800 trials, 0.6 %.

    The correlation within fewer clusters is hardly known, and intervals over them cover more.
    """
    covered = coverage(clusters, fraction, correlation)
    assert covered >= 0.93
    assert clusters < 12 or covered <= 0.97 + SLACK / 3.0


def test_five_clusters_cover_by_a_correlation_that_they_do_not_show() -> None:
    """No quantile has 93 to 97 % for both: a smaller one loses where the correlation is strong."""
    assert coverage(5, 0.8, 0.05) > 0.97 > 0.94 > coverage(5, 0.8, 0.6)


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


def test_intervals_stay_within_bounds_and_need_four_clusters() -> None:
    right, drives = np.ones(400, np.bool_), np.repeat(np.arange(4), 100)

    low, high = fraction_by_cluster(right, drives)
    assert 0.4 < low < 0.6
    assert high == 1.0
    assert fraction_by_cluster(~right, drives) == pytest.approx((0.0, 1.0 - low))
    assert np.isnan(fraction_by_cluster(right[:300], drives[:300])).all()
    assert np.isnan(mean_by_cluster(np.ones(300), drives[:300])).all()
    assert np.isnan(mean_of(np.ones(3)).low)
    assert np.isnan(range_at(np.arange(3.0), np.ones(3), 0.8).low)


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
