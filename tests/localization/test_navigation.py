"""Equation 4 and its memory: laws of angles, and what repeated decisions cost."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.localization.navigation import (
    Memory,
    Option,
    Strategy,
    bearing_after,
    choose,
    landmark_ahead,
    seeks_landmarks,
)

_ANGLE = st.floats(-math.pi, math.pi)
_OPTIONS = st.lists(st.builds(Option, _ANGLE, _ANGLE, st.floats(0.0, 3.0)), min_size=1, max_size=6)


def test_the_car_of_fig_13_goes_straight_on() -> None:
    goal = (80.0, 10.0)
    straight, right = 0.0, -math.pi / 2
    options = [Option(h, bearing_after(0.0, 0.0, h, goal, 10.0)) for h in (straight, right)]

    assert choose(options).option == 0


@given(options=_OPTIONS, turn=_ANGLE)
def test_turning_the_map_changes_no_cost(options: list[Option], turn: float) -> None:
    turned = [Option(o.heading_rad + turn, o.bearing_rad + turn, o.penalty_rad) for o in options]

    assert choose(turned).costs_rad == pytest.approx(choose(options).costs_rad, abs=1e-9)


@given(options=_OPTIONS)
def test_the_mirror_image_decides_alike(options: list[Option]) -> None:
    mirrored = [Option(-o.heading_rad, -o.bearing_rad, o.penalty_rad) for o in options]

    assert choose(mirrored).costs_rad == pytest.approx(choose(options).costs_rad, abs=1e-9)


def test_of_equal_options_the_first_is_taken() -> None:
    assert choose([Option(0.3, 0.0), Option(-0.3, 0.0)]).option == 0


def test_a_repeated_decision_costs_more_each_time_until_another_wins() -> None:
    memory = Memory(radius_m=30.0, penalty_rad=0.5, same_option_rad=0.5)
    headings, bearings = (0.0, math.pi / 2), (0.1, 0.1)
    taken = []
    for visit in range(6):
        # Each time the car believes itself a little elsewhere; the place is the same.
        x, y = 3.0 * visit, -2.0 * visit
        penalties = memory.penalties(x, y, headings)
        options = [Option(h, b, p) for h, b, p in zip(headings, bearings, penalties, strict=True)]
        taken.append(choose(options).option)
        memory.record(x, y, headings[taken[-1]])

    assert taken[:3] == [0, 0, 0]
    assert 1 in taken
    assert len(memory) == 1


def test_another_intersection_remembers_nothing() -> None:
    memory = Memory(radius_m=30.0, penalty_rad=0.5, same_option_rad=0.5)
    memory.record(0.0, 0.0, 0.0)

    assert memory.penalties(100.0, 0.0, (0.0,)) == (0.0,)


@pytest.mark.parametrize(
    ("options", "said"),
    [([], "at least one"), ([Option(math.nan, 0.0)], "finite"), ([Option(0.0, 0.0, -1.0)], ">= 0")],
)
def test_what_means_nothing_is_refused(options: list[Option], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        choose(options)


def test_a_landmark_must_be_on_the_way() -> None:
    car, goal = (0.0, 0.0), (100.0, 0.0)
    behind, beside, further = (-5.0, 0.0), (30.0, 5.0), (130.0, 0.0)
    landmarks = np.array([behind, beside, further])

    assert landmark_ahead(car, goal, landmarks, [False] * 3) == 1
    assert landmark_ahead(car, goal, landmarks, [False, True, False]) is None
    assert landmark_ahead(car, goal, np.empty((0, 2)), []) is None


def test_the_hybrid_seeks_landmarks_only_when_unsure() -> None:
    assert [seeks_landmarks(Strategy.HYBRID, m, 50.0) for m in (49.0, 51.0)] == [False, True]
    assert not seeks_landmarks(Strategy.STRAIGHT, 99.0, 50.0)
    assert seeks_landmarks(Strategy.LANDMARKS, 0.0, 50.0)
