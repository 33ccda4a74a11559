"""Change points are found at the right versions, with the stated rate of false alarms."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from crosscue.eval.scoring import change_points as module
from crosscue.eval.scoring.change_points import FALSE_ALARMS, MIN_PLACES, Results, change_points

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

    assert at(12) == at(MIN_PLACES) == [3]
    assert at(MIN_PLACES - 1) == []
    alike = module._shuffled(values, np.ones(values.shape, np.bool_), np.zeros(12, np.int64))
    first = np.array([[np.flatnonzero(values[d] == one)[0] for one in alike[7, d]] for d in (0, 5)])
    assert (first[0] == first[1]).all()
