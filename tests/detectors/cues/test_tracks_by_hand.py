"""Rules for tracked cars: every condition at its limit, with numbers worked out by hand."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from crosscue.detectors.cues.observed import CarCounts, Place, Sides, Ways
from crosscue.detectors.cues.tracked.judge import (
    along,
    cars_past,
    count_cars,
    crossing,
    crossing_gates,
    is_at,
    is_past,
    may_be_parked,
    parked,
)
from crosscue.detectors.cues.tracked.motion import CarMotion, Observation, motions_of, place_of_end
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


# Crosses at 5 m/s: more than 2 m/s and 3 * 0.5 m/s; along 6 = 5 + 2 * 0.5 m/s.
FAST = {"right_mps": 5.0, "ahead_mps": 6.0}


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
    [(28.5, 30.0, True), (28.6, 30.0, False), (10.0, 14.5, True), (10.0, 14.4, False)],
)
def test_car_is_at_the_intersection_within_the_doubt(
    start_m: float, end_m: float, counts: bool
) -> None:
    """20 + 1.5 = 21.5 m; the doubt is 2 * 2 + 0.15 * 20 = 7 m: start <= 28.5 m, end >= 14.5 m."""
    assert is_at(car(), CAMERA, Place(start_m, end_m, 2.0)) == counts


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

    found = count_cars([*moving, *others], standing, 9, CAMERA, RULES, PLACE)

    assert found == CarCounts(Sides(2, 1), Sides(1, 0), Sides(1, 2), Sides(0, 2), 9, 6)
    anywhere = count_cars([*moving, *others], standing, 9, CAMERA, RULES, None)
    assert anywhere == CarCounts(Sides(3, 3), Sides(0, 0), Sides(0, 0), Sides(1, 2), 9, 6)
    slow = RULES.model_copy(update={"crossing_mps": 0.5})
    slowly = car(right_mps=0.9, right_sd_mps=0.1)
    assert count_cars([slowly], [], 1, CAMERA, slow, None).crossing == Sides(0, 1)
    edge = count_cars([car(distance_m=100.0)], [], 1, CAMERA, RULES, None)
    assert edge.followed == 1


def test_cars_past_are_oncoming_and_outgoing() -> None:
    """At 80 m, 81.5 > 40 + 1.08 * 12.04 = 53.0 m: 2 oncoming and 1 outgoing; 20 m is not past."""
    away = car(ahead_mps=8.0, distance_m=80.0)
    cars = [away, away._replace(ahead_mps=-8.0), away._replace(ahead_mps=-9.0)]
    others = [car(distance_m=80.0), car(ahead_mps=8.0)]

    assert cars_past([*cars, *others], CAMERA, RULES, PLACE) == Ways(2, 1)
    slow = RULES.model_copy(update={"crossing_mps": 0.5})
    slowly = away._replace(ahead_mps=0.9, ahead_sd_mps=0.1)
    assert cars_past([slowly], CAMERA, slow, PLACE) == Ways(0, 1)
    assert cars_past(cars, CAMERA, RULES, None) is None
    assert cars_past(cars, CAMERA, RULES, Place(-10.0, 0.0, 1.0)) is None
    assert cars_past(cars, CAMERA, RULES, Place(-10.0, 0.5, 1.0)) == Ways(2, 1)


def observed(
    t_s: float, edges_rad: tuple[float, float] = (0.0, 0.0), **changes: Any
) -> Observation:
    """A car 10 m ahead of a camera at the origin."""
    one = Observation(t_s, (0.0, 0.0, 0.0), edges_rad, 10.0, 0.05, 3.0, 0)
    return one._replace(**changes)


@pytest.mark.parametrize(
    ("edge_rad", "pose", "newest_pose", "place"),
    [
        (0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (10.0, 0.0)),
        (math.pi / 4, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (10.0, 10.0)),
        (-math.pi / 4, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (10.0, -10.0)),
        (0.0, (5.0, 3.0, 0.0), (2.0, 1.0, 0.0), (13.0, -2.0)),
        (0.0, (5.0, 3.0, math.pi / 2), (2.0, 1.0, 0.0), (3.0, -12.0)),
        (0.0, (5.0, 3.0, 0.0), (2.0, 1.0, math.pi / 2), (2.0, 13.0)),
        (math.pi / 4, (0.0, 0.0, math.pi / 2), (0.0, 0.0, math.pi / 2), (10.0, 10.0)),
    ],
)
def test_end_of_a_car_is_placed_relative_to_the_newest_pose(
    edge_rad: float,
    pose: tuple[float, float, float],
    newest_pose: tuple[float, float, float],
    place: tuple[float, float],
) -> None:
    """10 m along the camera's axis, and 10 * tan(edge) to its right; then seen from the other pose.

    From (5, 3) with heading 0, the car is at (15, 3), which is (13, 2) from (2, 1): 13 m ahead
    and 2 to the left. With heading 90 degrees it is at (5, 13): (3, 12) from (2, 1).
    """
    one, newest = observed(0.0, (9.9, edge_rad), pose=pose), observed(1.0, pose=newest_pose)

    assert place_of_end(one, 1, newest) == pytest.approx(place)
    assert place_of_end(one._replace(edges_rad=(edge_rad, 9.9)), 0, newest) == pytest.approx(place)


def fitted(
    seen: Sequence[Observation], side: int, aside_mps: float
) -> tuple[float, float, float, float, float]:
    """Fit as ``motions_of`` does one end, by least squares of rows divided by their errors.

    Each observation has a row along its line of sight, with the error of the distance, and a row
    across it, with that of 1.55 m; two more rows are the prior speeds.
    """
    newest = seen[-1]
    rows: list[list[float]] = []
    values: list[float] = []
    for one in seen:
        x, y, heading = one.pose
        slant = one.distance_m / math.cos(one.edges_rad[side])
        at = complex(x - newest.pose[0], y - newest.pose[1]) + slant * np.exp(
            1j * (heading - one.edges_rad[side])
        )
        at *= np.exp(-1j * newest.pose[2])
        place = np.array([at.real, -at.imag])
        sight = np.exp(1j * (heading - one.edges_rad[side] - newest.pose[2]))
        along_m, across_m = np.array([sight.real, -sight.imag]), np.array([sight.imag, sight.real])
        late_s = one.t_s - newest.t_s
        for unit, sd in ((along_m, one.error * slant), (across_m, one.error * 1.55)):
            rows.append(list(np.concatenate([unit, late_s * unit]) / sd))
            values.append(float(unit @ place / sd))
    model, right = np.array(rows), np.array(values)
    prior = np.diag([0.0, 0.0, 0.1, 1.0 / aside_mps])[2:]
    whole, target = np.vstack([model, prior]), np.append(right, [0.0, 0.0])
    state = np.linalg.lstsq(whole, target)[0]
    sd = np.sqrt(np.diag(np.linalg.inv(whole.T @ whole)))
    misfit = float(((right - model @ state) ** 2).sum()) / max(2 * len(seen) - 4, 1)
    return float(state[3]), float(sd[3]), float(state[2]), float(sd[2]), misfit


def a_drive(seed: int, frames: int, jitter: float) -> list[Observation]:
    """A car that moves at a constant velocity, seen by a camera that drives a bend."""
    rng = np.random.default_rng(seed)
    right_mps, ahead_mps = rng.uniform(-4.0, 4.0, 2)
    found = []
    for k in range(frames):
        t_s = 0.2 * k
        pose = (1.6 * k, 0.1 * k * k, 0.05 * k)
        ahead_m, right_m = 30.0 + ahead_mps * t_s - 1.6 * k, 3.0 + right_mps * t_s
        edges = tuple(
            math.atan((right_m + end) / ahead_m) + jitter * float(rng.normal()) for end in (-2, 2)
        )
        noise, nose = rng.uniform(0.9, 1.1), int(rng.integers(-1, 2))
        found.append(
            Observation(
                3.0 + t_s,
                pose,
                (edges[0], edges[1]),
                ahead_m * noise,
                0.04 + 0.01 * k,
                2.0 + k % 3,
                nose,
            )
        )
    return found


@pytest.mark.parametrize("aside_mps", [10.0, 0.3])
@pytest.mark.parametrize(
    ("seed", "frames", "jitter"),
    [
        (1, 1, 0.0),
        (19, 5, 0.008),
        (2, 2, 0.0),
        (3, 3, 0.01),
        (4, 6, 0.0),
        (5, 6, 0.06),
        (6, 9, 0.02),
        (7, 5, 0.2),
        # Misfits of 5.5 and 2.9, of 2 frames and of 3.
        (2, 2, 0.2),
        (52, 3, 0.02),
    ],
)
def test_motion_is_the_least_squares_fit_of_both_ends(
    seed: int, frames: int, jitter: float, aside_mps: float
) -> None:
    """The slower end's speed where both have one sign; the larger error; the mean speed along.

    0.15 of the way over the time, or 10 m/s, is added to the error along. Steady: misfits of at
    most 4.
    """
    seen = a_drive(seed, frames, jitter)
    left, right = (fitted(seen, side, aside_mps) for side in (0, 1))
    newest = seen[-1]
    passed_s = 0.2 * (frames - 1)
    way_m = math.dist(newest.pose[:2], seen[0].pose[:2])
    doubt_mps = 0.15 * way_m / passed_s if frames > 1 else 10.0
    noses = [one.nose for one in seen if one.nose != 0]

    made = motions_of([seen], aside_mps)[0]

    slower = min(left[0], right[0], key=abs)
    assert made.right_mps == pytest.approx(slower if left[0] * right[0] > 0 else 0.0, rel=1e-5)
    assert made.right_sd_mps == pytest.approx(max(left[1], right[1]), rel=1e-5)
    assert made.ahead_mps == pytest.approx((left[2] + right[2]) / 2, rel=1e-5, abs=1e-9)
    assert made.ahead_sd_mps == pytest.approx(
        math.hypot((left[3] + right[3]) / 2, doubt_mps), rel=1e-5
    )
    assert made.is_steady == (left[4] <= 4.0 and right[4] <= 4.0)
    assert (made.number, made.frames, made.is_hidden) == (0, frames, False)
    assert made.distance_m == newest.distance_m
    assert made.bearing == pytest.approx(
        (math.tan(newest.edges_rad[0]) + math.tan(newest.edges_rad[1])) / 2
    )
    assert made.long == sorted(one.long for one in seen)[frames // 2] or frames % 2 == 0
    assert made.nose == pytest.approx(sum(noses) / len(noses) if noses else 0.0)
    # Each car is fitted alone; in a mirror its ends and its side change places.
    mirrored = [
        one._replace(
            pose=(one.pose[0], -one.pose[1], -one.pose[2]),
            edges_rad=(-one.edges_rad[1], -one.edges_rad[0]),
        )
        for one in seen
    ]
    again, other, _ = motions_of([seen, mirrored, a_drive(8, frames + 2, 0.0)], aside_mps)
    assert again[:11] == pytest.approx(made[:11])
    assert (other.right_mps, other.right_sd_mps) == pytest.approx(
        (-made.right_mps, made.right_sd_mps)
    )


@pytest.mark.parametrize(
    ("newest", "noses", "may_be"),
    [
        ({}, (0, 1, 0), True),
        ({}, (0, 0, -1), True),
        ({}, (1, 0, 0), False),  # not in the newest two frames
        ({"distance_m": 100.0}, (1, 1, 1), True),
        ({"distance_m": 100.1}, (1, 1, 1), False),
        ({"edges_rad": (math.atan(0.5), math.atan(0.69))}, (1, 1, 1), True),
        ({"edges_rad": (math.atan(0.5), math.atan(0.71))}, (1, 1, 1), False),
        ({"edges_rad": (math.atan(-0.5), math.atan(-0.71))}, (1, 1, 1), False),
    ],
)
def test_car_that_may_be_parked_is_near_ahead_and_shows_its_nose(
    newest: dict[str, Any], noses: tuple[int, int, int], may_be: bool
) -> None:
    """The mean of its ends is at most 0.6 of its distance aside, in the newest frame."""
    rules = RULES.model_copy(update={"parked_frames": 2})
    far = observed(0.0, (1.0, 1.0), distance_m=200.0, nose=noses[0])
    seen = [far, observed(0.1, nose=noses[1])]

    assert may_be_parked([*seen, observed(0.2, nose=noses[2], **newest)], rules) == may_be


def test_newest_observation_decides_whether_a_car_is_hidden() -> None:
    hidden = [observed(0.0), observed(0.1, is_hidden=True)]
    assert [one.is_hidden for one in motions_of([hidden, hidden[::-1]])] == [True, False]
    assert car(box_px=(1.0, 2.0, 5.0, 10.0)).center_px == (3.0, 6.0)
