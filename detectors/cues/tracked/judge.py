"""What followed cars do: cross, stand across the road, come towards the ego vehicle or go away.

* **Cross traffic** moves steadily across the ego vehicle's heading, significantly so.
* **Parked** is a car that surely stands, seen from the side, with a nose that most frames agree on,
  at an intersection whose distance is known: a car in a lot before it says nothing about its roads.
* **Oncoming and outgoing** cars move steadily along the ego vehicle's heading past the end of the
  intersection: where they drive, a road goes on. The source hears of such vehicles from a Mobileye
  (``far_side``). A camera knows a car's distance only by its height, to 15 %, so a car is past the
  end where that is 86 % probable, its own distance and the intersection's range taken together. One
  whose lower end is behind another car looks lower, hence further away, than it is, and says
  nothing, nor does a box narrower than high, which is a part of a car; one that only stands may be
  in a lot.

A car parked along the street is seen from the side, too, once it is far off the axis: at a bearing
``a`` its outline is about ``width + length * tan(a)`` long, that of a car across the street
``length + width * tan(a)``. Half way between lies ``length_per_height * (1 + |tan(a)|)`` heights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from crosscue.detectors.cues.observed import Judged, Place, Sides, Ways
from crosscue.detectors.cues.tracked.motion import HEIGHT_FRACTION, CarMotion
from crosscue.replay.vehicle.vehicle import Camera, Cars

MAX_BEARING: Final = 0.6
"""Further off the axis a car along the street is as long as one across it."""
SIGMAS: Final = 3.0
MIN_NOSE: Final = 0.5
"""Three of four frames agree on the nose."""
LIKELY: Final = 1.08
"""Standard deviations; one side of a Gaussian holds 86 % within them. That is for a car at the
limit; most that count are further past it (``PAST_PRECISION`` in the table of cues)."""
COMES_OR_GOES: Final = 2.0
"""Standard deviations of its speed; less is asked than across, since a standing car of another
height that is taken for a moving one is on that road, too."""
MIN_LONG: Final = 1.0
"""Width over height of a car seen from ahead or behind; a sedan has 1.2, a van 1.0. A box that is
narrower shows a part of a car, often together with what hides the rest, so its height is not the
car's, and seems to come or go as more of it shows."""
MAX_SLANT: Final = 0.5
"""Speed across over speed along; what moves at more than 27 degrees to the road turns."""


def crossing(cars: Sequence[CarMotion], settings: Cars) -> list[CarMotion]:
    """Cars that move steadily across the ego vehicle's heading."""
    return [car for car in cars if not crossing_gates(car, settings)]


def crossing_gates(car: CarMotion, settings: Cars) -> list[str]:
    """What speaks against a car's crossing; nothing for one that does."""
    fast_mps = max(settings.crossing_mps, SIGMAS * car.right_sd_mps)
    gates = {
        "seen too seldom": car.frames < settings.min_frames,
        "too far": car.distance_m > settings.within_m,
        "no steady motion": not car.is_steady,
        "not seen from the side": car.long <= settings.length_per_height,
        "not surely across": abs(car.right_mps) <= fast_mps,
        "moves along": abs(car.ahead_mps) > abs(car.right_mps) + 2.0 * car.ahead_sd_mps,
    }
    return [gate for gate, is_failed in gates.items() if is_failed]


def parked(cars: Sequence[CarMotion], settings: Cars) -> list[CarMotion]:
    """Cars that surely stand, across the ego vehicle's heading, with a nose."""
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


def judge(
    cars: Sequence[CarMotion],
    standing: Sequence[CarMotion],
    seen: int,
    camera: Camera,
    settings: Cars,
    place: Place | None,
) -> Judged:
    """Count what cars do, at the intersection and elsewhere.

    Args:
        cars: Those followed.
        standing: The same, by ``CarTracks.standing``; parked ones are among them.
        seen: How many cars were whole and near enough.
        camera: Where it sits.
        settings: Thresholds.
        place: Of the intersection; None where unknown: cross traffic then counts anywhere, and
            parked cars nowhere.
    """
    moving, still = crossing(cars, settings), parked(standing, settings)
    moving_here = [c for c in moving if place is None or is_at(c, camera, place)]
    still_here = [c for c in still if place is not None and is_at(c, camera, place)]
    followed = sum(
        car.frames >= settings.min_frames and car.distance_m <= settings.within_m for car in cars
    )
    crossing_here, crossing_all = _by_motion(moving_here), _by_motion(moving)
    parked_here, parked_all = _by_nose(still_here), _by_nose(still)
    return Judged(
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
    """Cars that come and go past the end of the intersection; None where unknown.

    Args:
        cars: Those followed, by ``CarTracks.longer``.
        camera: Where it sits.
        settings: Thresholds.
        place: Of the intersection.
    """
    if place is None or place.end_m <= 0.0:
        return None
    past = [car for car in along(cars, settings) if is_past(car, camera, place)]
    outgoing = sum(car.ahead_mps > 0.0 for car in past)
    return Ways(len(past) - outgoing, outgoing)


def along(cars: Sequence[CarMotion], settings: Cars) -> list[CarMotion]:
    """Cars that move steadily along the ego vehicle's heading, no further aside than its road."""
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


def is_past(car: CarMotion, camera: Camera, place: Place) -> bool:
    """Is a car past the end of the intersection, with 86 % probability?"""
    sd_m = math.hypot(HEIGHT_FRACTION * car.distance_m, place.sd_m)
    return car.distance_m + camera.x_m > place.end_m + LIKELY * sd_m


def is_at(car: CarMotion, camera: Camera, place: Place) -> bool:
    """Is a car between the start and the end of the intersection, as far as can be known?"""
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
