"""Tests of eq. 4 and its memory: invariance to rotation, and the cost of repeated decisions."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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
