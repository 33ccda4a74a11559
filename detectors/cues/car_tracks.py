"""Crossing and parked cars where the camera moves: followed over frames in the plane of the road.

The source takes a car's motion in the image for its own (eq. 15, 16), so a standing car beside the
road crosses, and a parked one moves. Here a car is followed over three or more frames, and every
observation becomes a position: its bearing from the picture, its distance from its height
(``focal_px * CAR_HEIGHT_M / height``), the camera's place and heading from odometry. A standing car
stays where it is, whatever the camera does: its motion in the image is thereby removed. Fitted is a
steady motion by generalised least squares, with errors along the line of sight that are much larger
than those across it. A car taller or lower than assumed only seems to move along the camera's own
way, never across it.

Both ends of a car are followed apart, and it moves sideways as little as either does: a car that
comes out from behind another one grows to one side only.

* **Cross traffic** moves steadily across the ego vehicle's heading, significantly so.
* **Parked** is a car that surely stands, seen from the side, with a nose that most frames agree on,
  at an intersection whose distance is known: a car in a lot before it says nothing of its roads.

A car parked along the street is seen from the side, too, once it is far off the axis: at a bearing
``a`` its outline is about ``width + length * tan(a)`` long, that of a car across the street
``length + width * tan(a)``. Half way between lies ``length_per_height * (1 + |tan(a)|)`` heights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from crosscue.detectors import rle
from crosscue.detectors.base import Detections
from crosscue.detectors.ranging.object_tracks import Motion
from crosscue.replay.columns import Floats
from crosscue.replay.vehicle.vehicle import Camera, Cars

from .observed import Judged, Place, Sides, nose_of

CAR_HEIGHT_M: Final = 1.55
"""Of a usual car; between 1.4 (sports car) and 1.8 (van), so 15 % either way."""
HEIGHT_FRACTION: Final = 0.15
BOX_PX: Final = 1.0
"""Standard deviation of a box's edge ..."""
BOX_FRACTION: Final = 0.03
"""... and what is added of the box's height."""
FASTEST_MPS: Final = 25.0
"""A car that would have gone faster between two frames is another one."""
USUAL_MPS: Final = 10.0
"""Standard deviation of a car's speed, before anything is known of it."""
GROWTH: Final = 1.4
"""Heights of one car in consecutive frames differ by less than this factor."""
BORDER_PX: Final = 2.0
"""A box that reaches the picture's edge is cut."""
MAX_BEARING: Final = 0.6
"""Further off the axis a car along the street is as long as one across it."""
SIGMAS: Final = 3.0
MIN_NOSE: Final = 0.5
"""Three of four frames agree on the nose."""
MAX_MISFIT: Final = 4.0
"""Of residuals, squared, per degree of freedom: beyond it the motion is not steady."""


class Observation(NamedTuple):
    """One box of a car.

    Attributes:
        t_s: Time.
        pose: Of the camera: x, y, heading in the plane of the road.
        edges_rad: Bearings of its left and right end, to the right of the camera's axis.
        distance_m: From its height.
        error: Standard deviation of the distance as a fraction, from the box alone.
        long: Length over height.
        nose: -1 left, 1 right, 0 unknown.
    """

    t_s: float
    pose: tuple[float, float, float]
    edges_rad: tuple[float, float]
    distance_m: float
    error: float
    long: float
    nose: int


class CarMotion(NamedTuple):
    """What is known of one car in the newest frame.

    Attributes:
        frames: In how many it was seen.
        distance_m: From the camera along its axis.
        bearing: Tangent, to the right.
        right_mps: Speed across the ego vehicle's heading, to the right; 0 where its ends disagree.
        right_sd_mps: Its standard deviation.
        ahead_mps: Speed along it.
        ahead_sd_mps: Its standard deviation.
        is_steady: One speed fits all frames.
        long: Length over height, median.
        nose: Mean of the noses seen, -1 to 1.
        center_px: Middle of its box.
        step_px: How that moved since it was seen last.
    """

    frames: int
    distance_m: float
    bearing: float
    right_mps: float
    right_sd_mps: float
    ahead_mps: float
    ahead_sd_mps: float
    is_steady: bool
    long: float
    nose: float
    center_px: tuple[float, float] = (0.0, 0.0)
    step_px: tuple[float, float] = (0.0, 0.0)


@dataclass(slots=True)
class _Track:
    box_px: Floats
    step_px: Floats
    seen: list[Observation] = field(default_factory=list)


class CarTracks:
    """Follows the cars in view; memory holds the newest observations of each.

    Attributes:
        seen: Cars in the newest frame that were whole and near enough.
    """

    def __init__(self, camera: Camera, settings: Cars) -> None:
        self.seen = 0
        self._camera = camera
        self._settings = settings
        self._tracks: list[_Track] = []
        self._axle = self._pose = (0.0, 0.0, 0.0)
        self._t_s = 0.0

    def restart(self) -> None:
        """Forget all cars."""
        self._tracks.clear()

    def __call__(self, found: Sequence[Detections], ego: Motion) -> list[CarMotion]:
        """Take the next frame.

        Args:
            found: One or more detectors' results for it.
            ego: Motion since the frame before; its way is known.

        Returns:
            One entry for each car that is in this frame and was in earlier ones, too.
        """
        self._axle = _moved(self._axle, ego)
        x, y, heading = self._axle
        ahead_m = self._camera.x_m
        self._pose = (x + ahead_m * math.cos(heading), y + ahead_m * math.sin(heading), heading)
        self._t_s += ego.seconds
        cars = self._observed(found)
        again = self._assign(cars)
        newest = self._t_s - self._settings.max_gap_s
        self._tracks = [one for one in self._tracks if one.seen[-1].t_s >= newest]
        self.seen = len(cars)
        return [_motion(track) for track in again]

    def _observed(self, found: Sequence[Detections]) -> list[tuple[Floats, Observation]]:
        cars = []
        for detections in found:
            for i, label in enumerate(detections.labels):
                is_car = label in self._settings.labels
                if is_car and detections.scores[i] > self._settings.score:
                    one = self._observation(detections, i)
                    if one is not None:
                        cars.append((detections.boxes_px[i], one))
        return cars

    def _observation(self, found: Detections, i: int) -> Observation | None:
        width, height = found.size_px
        x0, y0, x1, y1 = found.boxes_px[i].tolist()
        is_cut = min(x0, y0) < BORDER_PX or x1 > width - BORDER_PX or y1 > height - BORDER_PX
        focal_px = self._camera.focal_px or 0.0
        if is_cut or y1 <= y0 or x1 <= x0 or focal_px <= 0.0:
            return None
        distance_m = focal_px * CAR_HEIGHT_M / (y1 - y0)
        if distance_m > self._settings.within_m:
            return None
        center = (self._camera.center_px or (0.5 * width, 0.0))[0]
        edges = math.atan2(x0 - center, focal_px), math.atan2(x1 - center, focal_px)
        error = BOX_PX / (y1 - y0) + BOX_FRACTION
        mask = found.masks[i]
        nose = 0 if not mask else nose_of(rle.column_heights_px(mask, found.size_px))
        long = (x1 - x0) / (y1 - y0)
        return Observation(self._t_s, self._pose, edges, distance_m, error, long, nose)

    def _assign(self, cars: Sequence[tuple[Floats, Observation]]) -> list[_Track]:
        """Nearest to where a standing car must be first; new cars begin a track."""
        pairs = sorted(
            (away, i, j)
            for j, track in enumerate(self._tracks)
            for i, (_, one) in enumerate(cars)
            if (away := _away(track, one)) < math.inf
        )
        used: set[int] = set()
        taken: set[int] = set()
        again = []
        for _, i, j in pairs:
            if i in used or j in taken:
                continue
            used.add(i)
            taken.add(j)
            track = self._tracks[j]
            track.step_px = 0.5 * (cars[i][0] - track.box_px).reshape(2, 2).sum(axis=0)
            track.box_px = cars[i][0]
            track.seen.append(cars[i][1])
            del track.seen[: -self._settings.max_frames]
            again.append(track)
        self._tracks += [
            _Track(box, np.zeros(2), [one]) for i, (box, one) in enumerate(cars) if i not in used
        ]
        return again


def _motion(track: _Track) -> CarMotion:
    x0, y0, x1, y1 = track.box_px.tolist()
    step = float(track.step_px[0]), float(track.step_px[1])
    found = motion_of(track.seen)
    return found._replace(center_px=(0.5 * (x0 + x1), 0.5 * (y0 + y1)), step_px=step)


def motion_of(seen: Sequence[Observation]) -> CarMotion:
    """Fit a steady motion to a car's observations, of which there is at least one."""
    newest = seen[-1]
    ends = [_fit(seen, side) for side in (0, 1)]
    (left, left_sd, *_), (right, right_sd, *_) = ends
    agree = left * right > 0.0
    right_mps = math.copysign(min(abs(left), abs(right)), left) if agree else 0.0
    ahead_mps, ahead_sd = (0.5 * (ends[0][k] + ends[1][k]) for k in (2, 3))
    passed_s = newest.t_s - seen[0].t_s
    way_m = math.dist(newest.pose[:2], seen[0].pose[:2])
    scale_sd = HEIGHT_FRACTION * way_m / passed_s if passed_s > 0.0 else USUAL_MPS
    noses = [one.nose for one in seen if one.nose]
    return CarMotion(
        frames=len(seen),
        distance_m=newest.distance_m,
        bearing=0.5 * sum(map(math.tan, newest.edges_rad)),
        right_mps=right_mps,
        right_sd_mps=max(left_sd, right_sd),
        ahead_mps=ahead_mps,
        ahead_sd_mps=math.hypot(ahead_sd, scale_sd),
        is_steady=max(ends[0][4], ends[1][4]) <= MAX_MISFIT,
        long=float(np.median([one.long for one in seen])),
        nose=sum(noses) / len(noses) if noses else 0.0,
    )


def _fit(seen: Sequence[Observation], side: int) -> tuple[float, float, float, float, float]:
    """Speed to the right and its s.d., speed ahead and its s.d., misfit; of one end of a car."""
    newest = seen[-1]
    information = np.diag([0.0, 0.0, USUAL_MPS**-2, USUAL_MPS**-2])
    sums = np.zeros(4)
    rows = []
    for one in seen:
        place, weight = _place(one, side, newest)
        late_s = one.t_s - newest.t_s
        model = np.hstack([np.eye(2), late_s * np.eye(2)])
        information += model.T @ weight @ model
        sums += model.T @ weight @ place
        rows.append((place, weight, model))
    covariance = np.linalg.inv(information)
    state = covariance @ sums
    misfit = sum(
        float((place - model @ state) @ weight @ (place - model @ state))
        for place, weight, model in rows
    )
    freedom = max(2 * len(rows) - 4, 1)
    sd = np.sqrt(np.diagonal(covariance))
    return float(state[3]), float(sd[3]), float(state[2]), float(sd[2]), misfit / freedom


def _place(one: Observation, side: int, newest: Observation) -> tuple[Floats, Floats]:
    """Where an end of the car was, ahead and to the right of the newest camera, and its weight."""
    x, y, heading = one.pose
    sight = heading - one.edges_rad[side]
    far_m = one.distance_m / math.cos(one.edges_rad[side])
    ahead, aside = x - newest.pose[0], y - newest.pose[1]
    east, north = ahead + far_m * math.cos(sight), aside + far_m * math.sin(sight)
    turn = newest.pose[2]
    place = np.array(
        [
            east * math.cos(turn) + north * math.sin(turn),
            east * math.sin(turn) - north * math.cos(turn),
        ]
    )
    angle = newest.pose[2] - sight
    along = np.array([math.cos(angle), math.sin(angle)])
    across = np.array([-along[1], along[0]])
    along_sd, across_sd = one.error * far_m, one.error * CAR_HEIGHT_M
    weight = np.outer(along, along) / along_sd**2 + np.outer(across, across) / across_sd**2
    return place, weight


def _moved(axle: tuple[float, float, float], motion: Motion) -> tuple[float, float, float]:
    """The rear axle's pose after an arc."""
    x, y, heading = axle
    middle, way_m = heading + 0.5 * motion.turned_rad, motion.way_m or 0.0
    return (
        x + way_m * math.cos(middle),
        y + way_m * math.sin(middle),
        heading + motion.turned_rad,
    )


def _away(track: _Track, one: Observation) -> float:
    """Metres across the line of sight from where a standing car must be; infinite if another's."""
    last = track.seen[-1]
    places = [_place(last, side, one)[0] for side in (0, 1)]
    ahead_m = 0.5 * (places[0][0] + places[1][0])
    if ahead_m <= 0.0:
        return math.inf
    fastest_m = FASTEST_MPS * (one.t_s - last.t_s) + 0.5
    grown = one.distance_m / ahead_m
    limit = GROWTH * (1.0 + fastest_m / one.distance_m)
    if not 1.0 / limit < grown < limit:
        return math.inf
    scale = one.distance_m / ahead_m
    right_m = [one.distance_m * math.tan(edge) for edge in one.edges_rad]
    off = [abs(at - place[1] * scale) for at, place in zip(right_m, places, strict=True)]
    return min(off) if min(off) <= fastest_m else math.inf


def crossing(cars: Sequence[CarMotion], settings: Cars) -> list[CarMotion]:
    """Cars that move steadily across the ego vehicle's heading."""
    return [
        car
        for car in cars
        if car.frames >= settings.min_frames
        and car.is_steady
        and car.long > settings.length_per_height
        and abs(car.right_mps) > max(settings.crossing_mps, SIGMAS * car.right_sd_mps)
        and abs(car.ahead_mps) <= abs(car.right_mps) + 2.0 * car.ahead_sd_mps
    ]


def parked(cars: Sequence[CarMotion], settings: Cars) -> list[CarMotion]:
    """Cars that surely stand, across the ego vehicle's heading, with a nose."""
    return [
        car
        for car in cars
        if car.frames >= settings.min_frames
        and car.is_steady
        and abs(car.bearing) <= MAX_BEARING
        and car.long > settings.length_per_height * (1.0 + abs(car.bearing))
        and abs(car.right_mps) + 2.0 * car.right_sd_mps <= settings.crossing_mps
        and abs(car.ahead_mps) <= settings.crossing_mps + 2.0 * car.ahead_sd_mps
        and abs(car.nose) >= MIN_NOSE
    ]


def judge(
    cars: Sequence[CarMotion], seen: int, camera: Camera, settings: Cars, place: Place | None
) -> Judged:
    """Count what cars do, at the intersection and elsewhere.

    Args:
        cars: Those followed.
        seen: How many cars were whole and near enough.
        camera: Where it sits.
        settings: Thresholds.
        place: Of the intersection; None where unknown: cross traffic then counts anywhere, and
            parked cars nowhere.
    """
    moving, still = crossing(cars, settings), parked(cars, settings)
    moving_here = [c for c in moving if place is None or is_at(c, camera, place)]
    still_here = [c for c in still if place is not None and is_at(c, camera, place)]
    followed = sum(car.frames >= settings.min_frames for car in cars)
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
