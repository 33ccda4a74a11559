"""Rules for tracked cars: every condition at its limit, with numbers worked out by hand."""

from __future__ import annotations

from typing import Any

import pytest

from crosscue.detectors.cues.observed import Judged, Place, Sides, Ways
from crosscue.detectors.cues.tracked.judge import (
    along,
    cars_past,
    crossing,
    crossing_gates,
    is_at,
    is_past,
    judge,
    parked,
)
from crosscue.detectors.cues.tracked.motion import CarMotion
from crosscue.replay.vehicle.vehicle import Camera, Cars

RULES = Cars(
    kind="tracks",
    length_per_height=2.0,
    min_frames=3,
    within_m=100.0,
    crossing_mps=2.0,
    past_aside_m=12.0,
)
CAMERA = Camera(x_m=1.5)
PLACE = Place(start_m=20.0, end_m=40.0, sd_m=1.0)


def car(**changes: Any) -> CarMotion:
    """A standing car 20 m ahead, 3 heights long, with its nose at the right."""
    standing = CarMotion(
        number=1,
        frames=3,
        distance_m=20.0,
        bearing=0.0,
        right_mps=0.0,
        right_sd_mps=0.5,
        ahead_mps=0.0,
        ahead_sd_mps=0.5,
        is_steady=True,
        long=3.0,
        nose=1.0,
    )
    return standing._replace(**changes)


FAST = {"right_mps": 5.0, "ahead_mps": 6.0}
"""Crosses at 5 m/s: more than 2 m/s and 3 * 0.5 m/s; along 6 = 5 + 2 * 0.5 m/s."""


@pytest.mark.parametrize(
    ("changes", "gate"),
    [
        ({}, None),
        ({"frames": 2}, "seen in too few frames"),
        ({"distance_m": 100.0}, None),
        ({"distance_m": 100.1}, "too far"),
        ({"is_steady": False}, "no steady motion"),
        ({"long": 2.0}, "not seen from the side"),
        ({"long": 2.1}, None),
        ({"right_mps": 2.0, "ahead_mps": 0.0}, "not significantly across"),
        ({"right_mps": -2.1, "ahead_mps": 0.0}, None),
        ({"right_mps": 5.0, "right_sd_mps": 5.0 / 3.0}, "not significantly across"),
        ({"right_mps": -5.0, "right_sd_mps": 1.66}, None),
        ({"ahead_mps": 6.1}, "moves along"),
        ({"ahead_mps": -6.0}, None),
        ({"ahead_mps": -6.1}, "moves along"),
    ],
)
def test_crossing_car_fulfils_each_condition(changes: dict[str, Any], gate: str | None) -> None:
    """At least 3 frames within 100 m, longer than 2 heights, faster than 2 m/s and 3 sigma."""
    one = car(**{**FAST, **changes})

    assert crossing_gates(one, RULES) == ([] if gate is None else [gate])
    assert crossing([one], RULES) == ([one] if gate is None else [])


@pytest.mark.parametrize(
    ("changes", "counts"),
    [
        ({}, True),
        ({"frames": 2}, False),
        ({"distance_m": 100.0}, True),
        ({"distance_m": 100.1}, False),
        ({"is_steady": False}, False),
        ({"bearing": -0.6, "long": 3.21}, True),
        ({"bearing": 0.61, "long": 4.0}, False),
        ({"bearing": -0.5, "long": 3.0}, False),
        ({"bearing": 0.5, "long": 3.1}, True),
        ({"right_mps": -1.0}, True),
        ({"right_mps": 1.1}, False),
        ({"ahead_mps": -3.0}, True),
        ({"ahead_mps": 3.1}, False),
        ({"nose": -0.5}, True),
        ({"nose": 0.49}, False),
    ],
)
def test_parked_car_fulfils_each_condition(changes: dict[str, Any], counts: bool) -> None:
    """Length over height above 2 * (1 + |bearing|): at 0.5 above 3, at 0.6 above 3.2.

    |right| + 2 * 0.5 <= 2 m/s, |ahead| <= 2 + 2 * 0.5 m/s, and |nose| >= 0.5.
    """
    one = car(**changes)

    assert parked([one], RULES) == ([one] if counts else [])


@pytest.mark.parametrize(
    ("changes", "counts"),
    [
        ({}, True),
        ({"frames": 2}, False),
        ({"is_steady": False}, False),
        ({"is_hidden": True}, False),
        ({"long": 1.0}, True),
        ({"long": 0.99}, False),
        ({"bearing": -0.6}, True),
        ({"bearing": 0.61}, False),
        ({"ahead_mps": 2.0, "right_mps": 0.0}, False),
        ({"ahead_mps": -2.1, "right_mps": 0.0}, True),
        ({"ahead_sd_mps": 4.0}, False),
        ({"ahead_sd_mps": 3.9}, True),
        ({"right_mps": 4.1}, False),
        ({"ahead_mps": -8.0, "right_mps": -4.0}, True),
    ],
)
def test_car_along_the_road_fulfils_each_condition(changes: dict[str, Any], counts: bool) -> None:
    """8 m/s along and 4 across: 4 <= 0.5 * 8. At 20 m, 0.6 * 20 = 12 m aside. 8 > 2 * 3.9."""
    one = car(**{"ahead_mps": 8.0, "right_mps": 4.0, **changes})

    assert along([one], RULES) == ([one] if counts else [])


@pytest.mark.parametrize(
    ("distance_m", "end_m", "sd_m", "counts"),
    [
        (40.0, 34.47, 2.5, True),
        (40.0, 34.49, 2.5, False),
        (0.0, 1.5, 0.0, False),  # at the end, not past it
        (0.0, 1.49, 0.0, True),
    ],
)
def test_car_is_past_the_end_if_that_is_probable(
    distance_m: float, end_m: float, sd_m: float, counts: bool
) -> None:
    """0.15 * 40 = 6 m and 2.5 m: sqrt(36 + 6.25) = 6.5 m, times 1.08 is 7.02 m.

    40 + 1.5 = 41.5 m is past an end before 41.5 - 7.02 = 34.48 m.
    """
    assert is_past(car(distance_m=distance_m), CAMERA, Place(0.0, end_m, sd_m)) == counts


@pytest.mark.parametrize(
    ("start_m", "end_m", "counts"),
    [(26.5, 30.0, True), (26.6, 30.0, False), (10.0, 16.5, True), (10.0, 16.4, False)],
)
def test_car_is_at_the_intersection_within_the_doubt(
    start_m: float, end_m: float, counts: bool
) -> None:
    """20 + 1.5 = 21.5 m; the doubt is 2 * 1 + 0.15 * 20 = 5 m: start <= 26.5 m, end >= 16.5 m."""
    assert is_at(car(), CAMERA, Place(start_m, end_m, 1.0)) == counts


def test_cars_are_counted_by_side_here_and_elsewhere() -> None:
    """Of 6 crossing cars, 2 to the left and 1 to the right are here, 1 and 2 at 80 m elsewhere.

    Of 3 parked cars, 1 faces left here, 2 right elsewhere. Followed: of 8, one was seen in 2 frames
    and one is further than 100 m, so 6.
    """
    left, right = car(**FAST | {"right_mps": -7.0}), car(**FAST)
    far: dict[str, Any] = {"distance_m": 80.0}
    moving = [left, left, right, left._replace(**far), right._replace(**far), right._replace(**far)]
    others = [car(frames=2), car(distance_m=100.1)]
    standing = [car(nose=-1.0), car(**far), car(**far)]

    found = judge([*moving, *others], standing, 9, CAMERA, RULES, PLACE)

    assert found == Judged(Sides(2, 1), Sides(1, 0), Sides(1, 2), Sides(0, 2), 9, 6)
    anywhere = judge([*moving, *others], standing, 9, CAMERA, RULES, None)
    assert anywhere == Judged(Sides(3, 3), Sides(0, 0), Sides(0, 0), Sides(1, 2), 9, 6)
    edge = judge([car(distance_m=100.0)], [], 1, CAMERA, RULES, None)
    assert edge.followed == 1


def test_cars_past_are_oncoming_and_outgoing() -> None:
    """At 80 m, 81.5 > 40 + 1.08 * 12.04 = 53.0 m: 2 oncoming and 1 outgoing; 20 m is not past."""
    away = car(ahead_mps=8.0, distance_m=80.0)
    cars = [away, away._replace(ahead_mps=-8.0), away._replace(ahead_mps=-9.0)]
    others = [car(distance_m=80.0), car(ahead_mps=8.0)]

    assert cars_past([*cars, *others], CAMERA, RULES, PLACE) == Ways(2, 1)
    assert cars_past(cars, CAMERA, RULES, None) is None
    assert cars_past(cars, CAMERA, RULES, Place(-10.0, 0.0, 1.0)) is None
    assert cars_past(cars, CAMERA, RULES, Place(-10.0, 0.5, 1.0)) == Ways(2, 1)
