"""Tests of random cities: every goal can be reached from every reachable place."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as checked
from hypothesis import strategies as st

from crosscue.localization.town import settings as drive_settings
from crosscue.localization.town.drive import streets_of
from crosscue.localization.town.random_stream import RandomStream, stream_of
from crosscue.localization.town.settings import City, TownDrive, parameters_of
from crosscue.localization.town.streets import (
    Streets,
    draw_goal,
    draw_landmarks,
    draw_place,
    has_intersection,
    has_way,
    make_streets,
    node_position,
    step_of,
)
from crosscue.replay.compiled import compile_function

SMALL = TownDrive(city=City(largest_km2=3.0, one_way_fraction=0.5, dead_end_fraction=0.1))


def stream(seed: int, purpose: int = 7) -> RandomStream:
    with np.errstate(over="ignore"):
        return stream_of(np.uint64(seed), np.uint64(purpose))


def reachable(streets: Streets, start: int, *, backward: bool = False) -> set[int]:
    """Intersections reachable from ``start``, or with ``backward`` those that lead to it."""
    seen, queue = {start}, deque([start])
    while queue:
        node = queue.popleft()
        for way in range(4):
            there = node + step_of(way, len(streets.xs_m))
            if not 0 <= there < len(streets.ways) or there in seen:
                continue
            if has_way(streets.ways, *((there, (way + 2) % 4) if backward else (node, way))):
                seen.add(there)
                queue.append(there)
    return seen


@pytest.mark.slow
@given(seed=st.integers(0, 2**63))
@checked(deadline=None, max_examples=25)
def test_goal_is_reachable_from_every_reachable_intersection(seed: int) -> None:
    streets = streets_of(SMALL, seed)
    with np.errstate(over="ignore"):
        start, after = draw_place(stream(seed), streets.inside)
        goal, _ = draw_goal(after, streets, start, SMALL.city.goal_at_least_m)

    assert reachable(streets, start) <= reachable(streets, goal, backward=True)
    assert goal in reachable(streets, start)


@given(seed=st.integers(0, 2**63))
@checked(deadline=None, max_examples=25)
def test_every_street_leads_to_an_intersection_with_an_exit(seed: int) -> None:
    streets = streets_of(SMALL, seed)
    for node in range(len(streets.ways)):
        x, y = node_position(streets, node)
        for way, (dx, dy) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
            if has_way(streets.ways, node, way):
                there = node + step_of(way, len(streets.xs_m))
                there_x, there_y = node_position(streets, there)
                assert (np.sign(there_x - x), np.sign(there_y - y)) == (dx, dy)
                assert streets.ways[there] != 0


def test_compiled_city_matches_python_and_is_reproducible() -> None:
    with np.errstate(over="ignore"):
        plain = make_streets(stream(5, 1), parameters_of(SMALL))

    for one in (streets_of(SMALL, 5), streets_of(SMALL, 5)):
        for mine, other in zip(one, plain, strict=True):
            np.testing.assert_array_equal(mine, other)


def test_landmarks_are_distinct_and_of_the_requested_density() -> None:
    streets = streets_of(TownDrive(city=drive_settings.City(smallest_km2=50.0)), 2)
    draw = compile_function(draw_landmarks)
    drawn = [draw(stream(i), streets, 2.0)[0] for i in range(40)]

    assert np.mean([len(one) for one in drawn]) == pytest.approx(2.0 * streets.area_km2, rel=0.1)
    assert all(len(set(one.tolist())) == len(one) for one in drawn)


def test_single_street_has_no_intersection() -> None:
    ways = np.array([1, 5, 4], np.uint8)
    street = Streets(np.arange(3.0), np.zeros(1), ways, np.ones(3, np.bool_), 1.0)

    assert not has_intersection(street)
