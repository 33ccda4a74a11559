"""Decide which road to take at an intersection, from the direction of the goal (eq. 4).

    decision = argmin over options of |heading after - bearing to goal after| + penalty

``choose_option`` maps headings and bearings to a decision, for any number of roads at any angle.
The penalty grows each time the same option is taken at the same intersection, which the
dissertation compares to tabu search. Intersections are recognised by the *estimated* position only.
"""

import math
from enum import IntEnum
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Floats, Int64s

from .angles import wrap

Numbers = TypeVar("Numbers", Floats, Int64s)
# Index that stands for no place, no option or no landmark.
NONE: Final = -1
PLACES, OPTIONS = 0, 1
_ROOM: Final = 64


class Strategy(IntEnum):
    """Target of the car; the dissertation's three variants."""

    STRAIGHT = 0
    LANDMARKS = 1
    HYBRID = 2


# Strategies by their names in a study's settings.
STRATEGIES: Final = {
    "straight to goal": Strategy.STRAIGHT,
    "landmark to landmark": Strategy.LANDMARKS,
    "hybrid": Strategy.HYBRID,
}
_LANDMARKS: Final = int(Strategy.LANDMARKS)
_HYBRID: Final = int(Strategy.HYBRID)


def option_cost(heading_rad: float, bearing_rad: float, penalty_rad: float) -> float:
    """Cost in eq. 4: angle between an option's heading and the goal, plus the penalty."""
    return abs(wrap(heading_rad - bearing_rad)) + penalty_rad


def choose_option(headings_rad: Floats, bearings_rad: Floats, penalties_rad: Floats) -> int:
    """Index of the option of least cost (eq. 4), the first of equal ones.

    Args:
        headings_rad: Shape (N,): heading of the car after each option.
        bearings_rad: Shape (N,): bearing from the car to the goal after each option.
        penalties_rad: Shape (N,): penalty for earlier choices of the option.

    Raises:
        ValueError: There are no options.
    """
    if len(headings_rad) == 0:
        raise ValueError("choose: expected at least one option, found none")
    chosen, lowest = 0, np.inf
    for i in range(len(headings_rad)):
        cost = option_cost(headings_rad[i], bearings_rad[i], penalties_rad[i])
        if cost < lowest:
            chosen, lowest = i, cost
    return chosen


def bearing_after(
    x_m: float, y_m: float, heading_rad: float, goal_x_m: float, goal_y_m: float, after_m: float
) -> float:
    """Bearing to the goal after the car has left an intersection.

    Args:
        x_m: Estimated x of the intersection.
        y_m: Estimated y of the intersection.
        heading_rad: Heading of the chosen road.
        goal_x_m: X of the goal.
        goal_y_m: Y of the goal.
        after_m: Distance of the car along the chosen road.
    """
    after_x = x_m + after_m * math.cos(heading_rad)
    after_y = y_m + after_m * math.sin(heading_rad)
    return math.atan2(goal_y_m - after_y, goal_x_m - after_x)


class Memory(NamedTuple):
    """Estimated places of earlier decisions, with the options taken; arrays have spare capacity.

    Attributes:
        sizes: Shape (2,): number of places and of options.
        x_m: X of each place.
        y_m: Y of each place.
        first: Index of each place's first option.
        following: Index of the next option of the same place, or ``NONE``, for each option.
        headings_rad: Heading of each option.
        times: Number of times that each option was taken.
    """

    sizes: Int64s
    x_m: Floats
    y_m: Floats
    first: Int64s
    following: Int64s
    headings_rad: Floats
    times: Floats


def empty_memory() -> Memory:
    """Return a memory without decisions."""
    return Memory(
        np.zeros(2, np.int64),
        np.empty(_ROOM),
        np.empty(_ROOM),
        np.empty(_ROOM, np.int64),
        np.empty(_ROOM, np.int64),
        np.empty(_ROOM),
        np.empty(_ROOM),
    )


def recognise(memory: Memory, x_m: float, y_m: float, radius_m: float) -> int:
    """Index of the nearest known place within the radius, or ``NONE``."""
    nearest, lowest = NONE, radius_m**2
    for i in range(memory.sizes[PLACES]):
        square = (memory.x_m[i] - x_m) ** 2 + (memory.y_m[i] - y_m) ** 2
        if square < lowest:
            nearest, lowest = i, square
    return nearest


def known_option(memory: Memory, place: int, heading_rad: float, same_rad: float) -> int:
    """Index of a place's option of nearest heading, within ``same_rad``, or ``NONE``."""
    if place == NONE:
        return NONE
    nearest, lowest = NONE, same_rad
    option = memory.first[place]
    while option != NONE:
        apart = abs(wrap(memory.headings_rad[option] - heading_rad))
        if apart < lowest:
            nearest, lowest = option, apart
        option = memory.following[option]
    return nearest


def penalty(
    memory: Memory, place: int, heading_rad: float, same_rad: float, each_rad: float
) -> float:
    """Penalty of an option: ``each_rad`` for each time that it was taken at this place."""
    option = known_option(memory, place, heading_rad, same_rad)
    return 0.0 if option == NONE else each_rad * memory.times[option]


def remember(
    memory: Memory, place: int, x_m: float, y_m: float, heading_rad: float, same_rad: float
) -> Memory:
    """Add a decision at a place, or at a new place if ``place`` is ``NONE``."""
    if place == NONE:
        place = memory.sizes[PLACES]
        if place == len(memory.x_m):
            memory = _with_room_for_places(memory)
        memory.x_m[place], memory.y_m[place], memory.first[place] = x_m, y_m, NONE
        memory.sizes[PLACES] += 1
    option = known_option(memory, place, heading_rad, same_rad)
    if option != NONE:
        memory.times[option] += 1.0
        return memory
    option = memory.sizes[OPTIONS]
    if option == len(memory.times):
        memory = _with_room_for_options(memory)
    memory.sizes[OPTIONS] += 1
    memory.headings_rad[option], memory.times[option] = heading_rad, 1.0
    # New options are appended, because the first of equally near options counts.
    memory.following[option] = NONE
    if memory.first[place] == NONE:
        memory.first[place] = option
    else:
        last = memory.first[place]
        while memory.following[last] != NONE:
            last = memory.following[last]
        memory.following[last] = option
    return memory


def _with_room_for_places(memory: Memory) -> Memory:
    sizes, x_m, y_m, first, following, headings, times = memory
    return Memory(sizes, _doubled(x_m), _doubled(y_m), _doubled(first), following, headings, times)


def _with_room_for_options(memory: Memory) -> Memory:
    sizes, x_m, y_m, first, following, headings, times = memory
    return Memory(sizes, x_m, y_m, first, _doubled(following), _doubled(headings), _doubled(times))


def _doubled(numbers: Numbers) -> Numbers:
    larger = np.empty(2 * len(numbers), numbers.dtype)
    larger[: len(numbers)] = numbers
    return larger


def landmark_ahead(
    x_m: float,
    y_m: float,
    goal_x_m: float,
    goal_y_m: float,
    landmarks_m: Floats,
    is_visited: NDArray[np.bool_],
) -> int:
    """Index of the nearest landmark that brings the car closer to its goal, or ``NONE``.

    Landmarks further away than the goal and visited landmarks are left out.

    Args:
        x_m: Estimated x of the car.
        y_m: Estimated y of the car.
        goal_x_m: X of the goal.
        goal_y_m: Y of the goal.
        landmarks_m: Shape (L, 2).
        is_visited: Shape (L,).
    """
    to_goal = (goal_x_m - x_m) ** 2 + (goal_y_m - y_m) ** 2
    nearest, lowest = NONE, np.inf
    for i in range(len(landmarks_m)):
        lx, ly = landmarks_m[i, 0], landmarks_m[i, 1]
        to_car = (lx - x_m) ** 2 + (ly - y_m) ** 2
        left = (lx - goal_x_m) ** 2 + (ly - goal_y_m) ** 2
        if left < to_goal and to_car < to_goal and not is_visited[i] and to_car < lowest:
            nearest, lowest = i, to_car
    return nearest


def seeks_landmarks(strategy: int, major_axis_m: float, hybrid_above_m: float) -> bool:
    """Whether a strategy drives to landmarks at the current uncertainty."""
    if strategy == _HYBRID:
        return major_axis_m > hybrid_above_m
    return strategy == _LANDMARKS
