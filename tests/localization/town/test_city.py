"""Random cities can always be driven; what contradicts itself is refused."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.localization.town import settings as drive_settings
from crosscue.localization.town.city import (
    City,
    check_drivable,
    draw_goal,
    draw_landmarks,
    draw_place,
    find_route,
    make_city,
)
from crosscue.localization.town.random_stream import Stream, key_of

SMALL = drive_settings.City(largest_km2=3.0, one_way_share=0.5, dead_end_share=0.1)


@given(seed=st.integers(0, 2**63))
@settings(deadline=None, max_examples=25)
def test_every_goal_can_be_reached_from_wherever_the_car_may_go(seed: int) -> None:
    random = Stream(key_of(seed))
    made = make_city(random, SMALL)
    start = draw_place(random, made)
    goal = draw_goal(random, made, start, SMALL.goal_at_least_m)

    check_drivable(made.city, start, goal)
    route = find_route(made.city, start, goal)

    assert route is not None
    for here, there in pairwise(route):
        ways = np.flatnonzero(made.city.ways[here])
        assert there in [made.city.neighbour(here, int(way)) for way in ways]


def test_the_same_seed_gives_the_same_city() -> None:
    one, other = (make_city(Stream(key_of(5)), SMALL).city for _ in range(2))

    np.testing.assert_array_equal(one.ways, other.ways)
    np.testing.assert_array_equal(one.xs_m, other.xs_m)


def test_blocks_and_area_are_as_asked() -> None:
    for seed in range(20):
        city = make_city(Stream(key_of(seed)), drive_settings.City()).city
        for streets in (city.xs_m, city.ys_m):
            blocks = np.diff(streets)
            assert blocks.min() >= 50.0
            assert blocks.max() <= 300.0
        assert 1.0 <= city.area_km2 <= 100.0


def test_landmarks_are_as_dense_as_asked() -> None:
    made = make_city(Stream(key_of(2)), drive_settings.City(smallest_km2=50.0))
    counts = [len(draw_landmarks(Stream(key_of(i)), made, 2.0)) for i in range(40)]

    assert np.mean(counts) == pytest.approx(2.0 * made.city.area_km2, rel=0.1)


def _grid(ways: np.ndarray[tuple[int, int], np.dtype[np.bool_]]) -> City:
    return City(np.array([0.0, 100.0, 200.0]), np.array([0.0, 100.0]), ways, 1.0)


def _two_way() -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    ways = np.ones((2, 3, 4), np.bool_)
    ways[:, -1, 0] = ways[-1, :, 1] = ways[:, 0, 2] = ways[0, :, 3] = False
    return ways.reshape(6, 4)


def test_contradictory_one_way_streets_are_refused() -> None:
    ways = _two_way()
    ways[0] = False

    with pytest.raises(ValueError, match=r"contradict each other at \(0 m, 0 m\)"):
        _grid(ways)


def test_a_city_without_intersections_is_refused() -> None:
    ways = np.zeros((6, 4), np.bool_)
    ways[0, 0] = ways[1, 2] = True

    with pytest.raises(ValueError, match="no intersection"):
        _grid(ways)


def test_a_goal_that_cannot_be_reached_is_named() -> None:
    ways = _two_way()
    # Every way into the last corner is closed; ways out stay open.
    ways[4, 0] = ways[2, 1] = False

    with pytest.raises(ValueError, match=r"goal \(200 m, 100 m\): cannot be reached"):
        check_drivable(_grid(ways), 0, 5)


def test_random_numbers_are_uniform_normal_and_independent() -> None:
    one, other = Stream(key_of(1, 2)), Stream(key_of(1, 3))
    n = 20_000
    uniform = np.array([one.uniform() for _ in range(n)])
    normal = np.array([other.normal() for _ in range(n)])

    # Five standard errors of each moment.
    assert uniform.mean() == pytest.approx(0.5, abs=5 * (1 / 12 / n) ** 0.5)
    assert normal.mean() == pytest.approx(0.0, abs=5 * n**-0.5)
    assert normal.var() == pytest.approx(1.0, abs=5 * (2 / n) ** 0.5)
    assert (normal**4).mean() == pytest.approx(3.0, abs=5 * (96 / n) ** 0.5)
    assert abs(np.corrcoef(uniform, normal)[0, 1]) < 5 * n**-0.5
    assert abs(np.corrcoef(uniform[:-1], uniform[1:])[0, 1]) < 5 * n**-0.5
