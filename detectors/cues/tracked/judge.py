"""Classify tracked cars: crossing, parked across the road, oncoming, outgoing.

* **Cross traffic** moves steadily and significantly across the ego vehicle's heading.
* A **parked** car certainly stands, is seen from the side, and has the same nose in most frames. It
  is at an intersection of known distance, because a car in a lot before the intersection is no
  evidence of its roads.
* **Oncoming and outgoing** cars move steadily along the ego vehicle's heading past the end of the
  intersection, so a road continues there. The dissertation gets such vehicles from a Mobileye
  (``far_side``). A camera measures a car's distance only by its height, to 15 %. A car is past the
  end if that is 86 % probable, given the uncertainty of its distance and of the intersection's
  range. Three kinds of boxes do not count. A car whose lower end is behind another car looks lower,
  hence further away, than it is. A box narrower than high shows only a part of a car. A standing
  car may be in a lot.

A car parked along the street is also seen from the side if it is far off the axis. At bearing ``a``
its outline is about ``width + length * tan(a)`` long; that of a car across the street is
``length + width * tan(a)``. The bound is half way between: ``length_per_height * (1 + |tan(a)|)``
heights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from crosscue.detectors.cues.observed import CarCounts, Place, Sides, Ways
from crosscue.detectors.cues.tracked.motion import HEIGHT_FRACTION, CarMotion, Observation
from crosscue.replay.vehicle.vehicle import Camera, Cars

# Bearing beyond which a car along the street looks as long as one across it.
MAX_BEARING: Final = 0.6
SIGMAS: Final = 3.0
# Minimum magnitude of the mean nose: three of four frames agree.
MIN_NOSE: Final = 0.5
# Number of standard deviations for a one-sided probability of 86 %. It applies to a car at the
# limit; most cars that count are further past it (``PAST_PRECISION`` in the table of cues).
LIKELY: Final = 1.08
# Minimum speed along the road, in its standard deviations. It is lower than for cross traffic,
# because a standing car of unusual height that appears to move is on that road, too.
COMES_OR_GOES: Final = 2.0
# Minimum width over height of a car seen from the front or rear; a sedan has 1.2, a van 1.0. A
# narrower box shows a part of a car, often with the object that hides the rest. Its height is not
# the car's, and the car appears to move as more of it becomes visible.
MIN_LONG: Final = 1.0
# Maximum of speed across over speed along; a car at more than 27 degrees to the road turns.
MAX_SLANT: Final = 0.5


def crossing(cars: Sequence[CarMotion], settings: Cars) -> list[CarMotion]:
    """Select cars that move steadily across the ego vehicle's heading."""
    return [car for car in cars if not crossing_gates(car, settings)]


def crossing_gates(car: CarMotion, settings: Cars) -> list[str]:
    """Reasons why a car does not count as crossing; empty if it does."""
    fast_mps = max(settings.crossing_mps, SIGMAS * car.right_sd_mps)
    gates = {
        "seen in too few frames": car.frames < settings.min_frames,
        "too far": car.distance_m > settings.within_m,
        "no steady motion": not car.is_steady,
        "not seen from the side": car.long <= settings.length_per_height,
        "not significantly across": abs(car.right_mps) <= fast_mps,
        "moves along": abs(car.ahead_mps) > abs(car.right_mps) + 2.0 * car.ahead_sd_mps,
    }
    return [gate for gate, is_failed in gates.items() if is_failed]


def parked(cars: Sequence[CarMotion], settings: Cars) -> list[CarMotion]:
    """Select cars that certainly stand across the ego vehicle's heading, with a known nose."""
    return [
        car
        for car in cars
        if car.frames >= settings.min_frames
        and car.distance_m <= settings.within_m
        and car.is_steady
        and abs(car.bearing) <= MAX_BEARING
        and car.long > settings.length_per_height * (1.0 + abs(car.bearing))
        and abs(car.right_mps) + 2.0 * car.right_sd_mps <= settings.crossing_mps
        and abs(car.ahead_mps) <= settings.crossing_mps + 2.0 * car.ahead_sd_mps
        and abs(car.nose) >= MIN_NOSE
    ]


def may_be_parked(seen: Sequence[Observation], settings: Cars) -> bool:
    """Whether ``parked`` can select a car with these observations, however it moves."""
    newest = seen[-1]
    bearing = 0.5 * sum(map(math.tan, newest.edges_rad))
    return (
        newest.distance_m <= settings.within_m
        and abs(bearing) <= MAX_BEARING
        and any(one.nose for one in seen[-settings.parked_frames :])
    )


def count_cars(
    cars: Sequence[CarMotion],
    standing: Sequence[CarMotion],
    seen: int,
    camera: Camera,
    settings: Cars,
    place: Place | None,
) -> CarCounts:
    """Count cars by behaviour, at the intersection and elsewhere.

    Args:
        cars: Tracked cars.
        standing: The same cars by ``CarTracks.standing``, from which parked ones are selected.
        seen: Number of cars that were completely visible and near enough.
        camera: Mounting of the camera.
        settings: Thresholds.
        place: Position of the intersection. If None, cross traffic counts anywhere, and parked
            cars count nowhere.
    """
    moving, still = crossing(cars, settings), parked(standing, settings)
    moving_here = [c for c in moving if place is None or is_at(c, camera, place)]
    still_here = [c for c in still if place is not None and is_at(c, camera, place)]
    followed = sum(
        car.frames >= settings.min_frames and car.distance_m <= settings.within_m for car in cars
    )
    crossing_here, crossing_all = _by_motion(moving_here), _by_motion(moving)
    parked_here, parked_all = _by_nose(still_here), _by_nose(still)
    return CarCounts(
        crossing_here,
        parked_here,
        _less(crossing_all, crossing_here),
        _less(parked_all, parked_here),
        seen,
        followed,
    )


def cars_past(
    cars: Sequence[CarMotion], camera: Camera, settings: Cars, place: Place | None
) -> Ways | None:
    """Count oncoming and outgoing cars past the end of the intersection; None where unknown.

    Args:
        cars: Tracked cars, by ``CarTracks.longer``.
        camera: Mounting of the camera.
        settings: Thresholds.
        place: Position of the intersection.
    """
    if place is None or place.end_m <= 0.0:
        return None
    past = [car for car in along(cars, settings) if is_past(car, camera, place)]
    outgoing = sum(car.ahead_mps > 0.0 for car in past)
    return Ways(len(past) - outgoing, outgoing)


def along(cars: Sequence[CarMotion], settings: Cars) -> list[CarMotion]:
    """Select cars that move steadily along the ego vehicle's heading, within its road's width."""
    return [
        car
        for car in cars
        if car.frames >= settings.min_frames
        and car.is_steady
        and not car.is_hidden
        and car.long >= MIN_LONG
        and abs(car.bearing) * car.distance_m <= settings.past_aside_m
        and abs(car.ahead_mps) > max(settings.crossing_mps, COMES_OR_GOES * car.ahead_sd_mps)
        and abs(car.right_mps) <= MAX_SLANT * abs(car.ahead_mps)
    ]


def in_legs(
    cars: Sequence[CarMotion], camera: Camera, settings: Cars, place: Place | None
) -> Sides | None:
    """Count cars that move across within the left and the right leg; None where unknown.

    A car that comes out of a leg, turns into it or crosses is in that leg while it is further
    aside than the ego road is wide. Cars that stand there, in a queue or parked, do not count.

    Args:
        cars: Tracked cars.
        camera: Mounting of the camera.
        settings: Thresholds.
        place: Position of the intersection.
    """
    if place is None or place.end_m <= 0.0:
        return None
    here = [car for car in crossing(cars, settings) if is_at(car, camera, place)]
    right_m = [car.bearing * car.distance_m for car in here]
    aside_m = settings.past_aside_m
    return Sides(sum(at < -aside_m for at in right_m), sum(at > aside_m for at in right_m))


def is_past(car: CarMotion | Observation, camera: Camera, place: Place) -> bool:
    """Whether a car is past the end of the intersection, with a probability of 86 %."""
    sd_m = math.hypot(HEIGHT_FRACTION * car.distance_m, place.sd_m)
    return car.distance_m + camera.x_m > place.end_m + LIKELY * sd_m


def is_at(car: CarMotion, camera: Camera, place: Place) -> bool:
    """Whether a car is between the intersection's start and end, within the uncertainty."""
    away_m = car.distance_m + camera.x_m
    doubt_m = 2.0 * place.sd_m + HEIGHT_FRACTION * car.distance_m
    return place.start_m - doubt_m <= away_m <= place.end_m + doubt_m


def _by_motion(cars: Sequence[CarMotion]) -> Sides:
    right = sum(car.right_mps > 0.0 for car in cars)
    return Sides(len(cars) - right, right)


def _by_nose(cars: Sequence[CarMotion]) -> Sides:
    right = sum(car.nose > 0.0 for car in cars)
    return Sides(len(cars) - right, right)


def _less(all_of_them: Sides, some: Sides) -> Sides:
    return Sides(all_of_them.left - some.left, all_of_them.right - some.right)
