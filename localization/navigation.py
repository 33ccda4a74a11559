"""Which way to go at an intersection, knowing little more than where the goal lies (eq. 4).

    decision = argmin over options of |heading after - bearing to goal after| + penalty

Usable alone: headings and bearings in, decision out, for any number of roads at any angle. The
penalty grows each time the same option is taken at the same intersection, which the source likens
to Tabu search. Intersections are recognised from the *estimated* position only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

import numpy as np

from crosscue.replay.columns import Floats

from .angles import wrap


class Strategy(Enum):
    """What the car drives to; the source's three variants."""

    STRAIGHT = "straight to goal"
    LANDMARKS = "landmark to landmark"
    HYBRID = "hybrid"


class Option(NamedTuple):
    """One way to leave an intersection.

    Attributes:
        heading_rad: Of the car after it.
        bearing_rad: Direction from the car to the goal after it.
        penalty_rad: For having done so here before.
    """

    heading_rad: float
    bearing_rad: float
    penalty_rad: float = 0.0


class Decision(NamedTuple):
    """The way chosen.

    Attributes:
        option: Its place in the list.
        costs_rad: Of every option.
    """

    option: int
    costs_rad: tuple[float, ...]


def choose(options: Sequence[Option]) -> Decision:
    """The option of least cost (eq. 4); of equal ones the first.

    Raises:
        ValueError: No options, an angle that is not finite, or a negative penalty.
    """
    if not options:
        raise ValueError("choose: want at least one option, got none")
    for i, option in enumerate(options):
        if not all(map(math.isfinite, option)) or option.penalty_rad < 0.0:
            raise ValueError(f"option {i}: want finite angles and a penalty >= 0, got {option}")
    costs = tuple(abs(wrap(o.heading_rad - o.bearing_rad)) + o.penalty_rad for o in options)
    return Decision(costs.index(min(costs)), costs)


def bearing_after(
    x_m: float, y_m: float, heading_rad: float, goal_m: tuple[float, float], after_m: float
) -> float:
    """Direction to the goal once the car has left an intersection.

    Args:
        x_m: Of the intersection, as believed.
        y_m: Likewise.
        heading_rad: Of the road taken.
        goal_m: Shape (2,).
        after_m: How far into that road the car is then.
    """
    after_x = x_m + after_m * math.cos(heading_rad)
    after_y = y_m + after_m * math.sin(heading_rad)
    return math.atan2(goal_m[1] - after_y, goal_m[0] - after_x)


@dataclass(slots=True)
class _Place:
    x_m: float
    y_m: float
    headings_rad: list[float] = field(default_factory=list)
    times: list[int] = field(default_factory=list)


@dataclass(slots=True)
class Memory:
    """Places where the car believes to have decided, and what it did there.

    Attributes:
        radius_m: A place is recognised within this distance; the nearest counts.
        penalty_rad: Added for each time that an option was taken.
        same_option_rad: Roads whose headings differ by less are one option.
    """

    radius_m: float
    penalty_rad: float
    same_option_rad: float
    _places: list[_Place] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Refuse settings that mean nothing.

        Raises:
            ValueError: Not positive or, for the penalty, negative.
        """
        if not (self.radius_m > 0.0 and self.same_option_rad > 0.0 and self.penalty_rad >= 0.0):
            raise ValueError(
                f"memory: want radius and angle > 0, penalty >= 0; got {self.radius_m}, "
                f"{self.same_option_rad}, {self.penalty_rad}"
            )

    def __len__(self) -> int:
        return len(self._places)

    def penalties(self, x_m: float, y_m: float, headings_rad: Sequence[float]) -> tuple[float, ...]:
        """The penalty of each option at an intersection believed to be here."""
        place = self._recognised(x_m, y_m)
        if place is None:
            return (0.0,) * len(headings_rad)
        found = [self._option(place, heading) for heading in headings_rad]
        return tuple(0.0 if i is None else self.penalty_rad * place.times[i] for i in found)

    def record(self, x_m: float, y_m: float, heading_rad: float) -> None:
        """Remember that the road of this heading was taken here."""
        place = self._recognised(x_m, y_m)
        if place is None:
            place = _Place(x_m, y_m)
            self._places.append(place)
        i = self._option(place, heading_rad)
        if i is None:
            place.headings_rad.append(heading_rad)
            place.times.append(1)
        else:
            place.times[i] += 1

    def _recognised(self, x_m: float, y_m: float) -> _Place | None:
        nearest, least = None, self.radius_m**2
        for place in self._places:
            square = (place.x_m - x_m) ** 2 + (place.y_m - y_m) ** 2
            if square < least:
                nearest, least = place, square
        return nearest

    def _option(self, place: _Place, heading_rad: float) -> int | None:
        nearest, least = None, self.same_option_rad
        for i, known in enumerate(place.headings_rad):
            apart = abs(wrap(known - heading_rad))
            if apart < least:
                nearest, least = i, apart
        return nearest


def landmark_ahead(
    xy_m: tuple[float, float],
    goal_m: tuple[float, float],
    landmarks_m: Floats,
    is_visited: Sequence[bool],
) -> int | None:
    """The nearest landmark that brings the car closer to its goal, or None.

    A landmark further off than the goal itself is no help on the way; neither is one that was
    visited already.

    Args:
        xy_m: Where the car believes to be.
        goal_m: Where it wants to.
        landmarks_m: Shape (L, 2).
        is_visited: Of each landmark.
    """
    if not len(landmarks_m):
        return None
    to_goal = (goal_m[0] - xy_m[0]) ** 2 + (goal_m[1] - xy_m[1]) ** 2
    to_car = (landmarks_m[:, 0] - xy_m[0]) ** 2 + (landmarks_m[:, 1] - xy_m[1]) ** 2
    left = (landmarks_m[:, 0] - goal_m[0]) ** 2 + (landmarks_m[:, 1] - goal_m[1]) ** 2
    helps = (left < to_goal) & (to_car < to_goal) & ~np.asarray(is_visited)
    return int(np.argmin(np.where(helps, to_car, np.inf))) if helps.any() else None


def seeks_landmarks(strategy: Strategy, major_axis_m: float, hybrid_above_m: float) -> bool:
    """Does this strategy look for landmarks at the present uncertainty?"""
    if strategy is Strategy.HYBRID:
        return major_axis_m > hybrid_above_m
    return strategy is Strategy.LANDMARKS
