"""Track cars over frames in the road plane, with a moving camera.

The dissertation uses a car's motion in the image (eq. 15, 16), so a standing car next to the road
appears to cross, and a parked one appears to move. Here a car is tracked over three or more frames.
Each box is converted to a position on the road (``motion``), and a car is also searched for where
it would be if it stood.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import Detections
from crosscue.detectors.boxes import box_ious
from crosscue.detectors.cues.observed import nose_of
from crosscue.detectors.cues.tracked.motion import (
    ALONG_ASIDE_MPS,
    CAR_HEIGHT_M,
    USUAL_MPS,
    CarMotion,
    Observation,
    Windows,
    numbers_of,
    place_of_end,
)
from crosscue.detectors.ranging.ground_plane import GroundPlane
from crosscue.detectors.ranging.object_tracks import CarStep
from crosscue.detectors.ranging.usable import are_cut
from crosscue.replay.vehicle.vehicle import Camera, Cars

# Constant part of the standard deviation of a box's height.
BOX_PX: Final = 1.0
# Part of that standard deviation proportional to the height; the two add in squares.
BOX_FRACTION: Final = 0.03
# Maximum speed of a car between two frames; a faster one is a different car.
FASTEST_MPS: Final = 25.0
# Maximum distance of oncoming and outgoing cars, unless a car farther away is large enough.
PAST_WITHIN_M: Final = 120.0
# Minimum height of a car farther away than ``PAST_WITHIN_M``. A pixel is then 7 % of the height,
# less than half of the spread of car heights.
FAR_PX: Final = 15.0
# Replaces ``BOX_FRACTION`` for a car whose lower end is hidden.
HIDDEN_FRACTION: Final = 0.15
# Minimum intersection over union of a car's box with the predicted box.
MIN_OVERLAP: Final = 0.4
# Weight of the newest step in the smoothed speed of a box's edges, because boxes jitter.
NEWEST: Final = 0.5
# Maximum difference of one car's heights in two frames, in standard deviations, apart from its
# motion.
ERRORS: Final = 2.0
# Maximum ratio of one car's heights in consecutive frames.
GROWTH: Final = 1.4
# Distance to the picture's edge within which a box counts as cut.
# Fraction of a box's lower end behind another car above which its height is not the car's.
MAX_COVERED: Final = 0.3


Wanted = Callable[[Sequence[Observation]], bool]


def _any(seen: Sequence[Observation]) -> bool:
    return True


@dataclass(slots=True)
class _Track:
    number: int
    box_px: NDArray[np.float64]
    edges_pxps: NDArray[np.float64]
    seen: list[Observation]
    numbers: bytearray
    step_px: tuple[float, float] = (0.0, 0.0)

    def take(self, box_px: NDArray[np.float64], one: Observation, settings: Cars) -> None:
        """Add the observation of the newest frame."""
        steps_px = box_px - self.box_px
        edges_pxps = steps_px / (one.t_s - self.seen[-1].t_s)
        is_first = len(self.seen) == 1
        self.edges_pxps += (1.0 if is_first else NEWEST) * (edges_pxps - self.edges_pxps)
        x0, y0, x1, y1 = steps_px.tolist()
        self.step_px = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
        self.box_px = box_px
        self.seen.append(one)
        self.numbers += numbers_of(one)
        most = max(settings.max_frames, settings.parked_frames, settings.past_frames)
        if len(self.seen) > most:
            del self.numbers[: len(self.numbers) // len(self.seen)], self.seen[0]


class CarTracks:
    """Tracks the cars in view; it stores the newest observations of each.

    Attributes:
        seen: Number of cars in the newest frame that were completely visible and near enough.
    """

    def __init__(self, camera: Camera, settings: Cars) -> None:
        self.seen = 0
        self._camera = camera
        self._settings = settings
        self._farthest_m = max(settings.within_m, past_within_m(camera, settings))
        self._tracks: list[_Track] = []
        self._again: list[_Track] = []
        self._windows = Windows([], [])
        self._axle = self._pose = (0.0, 0.0, 0.0)
        self._t_s = 0.0
        self._begun = 0

    def __call__(self, found: Sequence[Detections], ego: CarStep) -> list[CarMotion]:
        """Update the tracks with the next frame.

        Args:
            found: One or more detectors' results for it.
            ego: Motion since the previous frame, with a known path.

        Returns:
            One entry for each car that is certainly in this frame and was also in earlier ones.
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
        within_m = self._settings.within_m
        self.seen = sum(one.is_sure and one.distance_m <= within_m for _, one in cars)
        self._again = [track for track in again if track.seen[-1].is_sure]
        self._windows = Windows(
            [track.seen for track in self._again], [track.numbers for track in self._again]
        )
        return self._motions([(i, self._settings.max_frames) for i in range(len(self._again))])

    def longer(self, wanted: Wanted = _any) -> list[CarMotion]:
        """Fit the same cars to their newest ``past_frames``, because distant cars grow slowly.

        The cars are assumed to be on the ego vehicle's road (``ALONG_ASIDE_MPS``). If no constant
        velocity fits all frames, fewer are used, but at least ``max_frames``: the car has started
        to move, or two cars were confused.

        Args:
            wanted: Selects cars by their observations, oldest first.
        """
        return self._steady(self._settings.past_frames, wanted, ALONG_ASIDE_MPS)

    def standing(self, wanted: Wanted = _any) -> list[CarMotion]:
        """Fit the same cars to their newest ``parked_frames``, because standing shows late.

        If no constant velocity fits all frames, fewer are used, as in ``longer``.

        Args:
            wanted: Selects cars by their observations, oldest first.
        """
        return self._steady(self._settings.parked_frames, wanted, USUAL_MPS)

    def _steady(self, frames: int, wanted: Wanted, aside_mps: float) -> list[CarMotion]:
        shortest = self._settings.max_frames
        cars = [(i, frames) for i, one in enumerate(self._again) if wanted(one.seen)]
        found = self._motions(cars, aside_mps)
        while again := [
            k for k, one in enumerate(found) if not one.is_steady and one.frames > shortest
        ]:
            fewer = [(cars[k][0], max(found[k].frames // 2, shortest)) for k in again]
            for k, one in zip(again, self._motions(fewer, aside_mps), strict=True):
                found[k] = one
        return found

    def _motions(
        self, windows: Sequence[tuple[int, int]], aside_mps: float = USUAL_MPS
    ) -> list[CarMotion]:
        """Fit the motion of cars of the newest frame, each to a number of its newest frames."""
        return [
            found._replace(
                number=track.number, box_px=tuple(track.box_px.tolist()), step_px=track.step_px
            )
            for found, (i, _) in zip(
                self._windows.motions(windows, aside_mps), windows, strict=True
            )
            for track in (self._again[i],)
        ]

    def _observed(
        self, found: Sequence[Detections]
    ) -> list[tuple[NDArray[np.float64], Observation]]:
        rows = [
            (detections, i, is_sure)
            for detections in found
            for i, is_sure in enumerate(detections.are_sure(self._settings.score).tolist())
            if detections.labels[i] in self._settings.labels
        ]
        boxes_px = np.array([found.boxes_px[i] for found, i, _ in rows]).reshape(-1, 4)
        are_sure = np.array([is_sure for *_, is_sure in rows], np.bool_)
        if not rows:
            return []
        size_px, focal_px = found[0].size_px, self._camera.focal_px or 0.0
        x0, y0, x1, y1 = boxes_px.T
        middle = 0.5 * (y0 + y1)
        ends_px = np.column_stack([x0, middle, x1, middle]).reshape(-1, 2)
        rays = GroundPlane.of(self._camera, size_px).rays(ends_px).reshape(-1, 2, 3)
        high = y1 - y0
        is_cut = are_cut(boxes_px, size_px) | (high <= 0.0) | (x1 <= x0)
        are_whole = ~is_cut & (rays[:, :, 0].min(axis=1) > 0.0) & (focal_px > 0.0)
        with np.errstate(divide="ignore"):
            away_m = focal_px * CAR_HEIGHT_M / high * rays[:, :, 0].mean(axis=1)
        edges_rad = np.arctan2(-rays[:, :, 1], rays[:, :, 0])
        are_hid = are_hidden(boxes_px, are_sure)
        cars = []
        for n in np.flatnonzero(are_whole & (away_m <= self._farthest_m)).tolist():
            detections, i, is_sure = rows[n]
            high_px, fraction = float(high[n]), HIDDEN_FRACTION if are_hid[n] else BOX_FRACTION
            heights_px = detections.column_heights_px(i)
            one = Observation(
                self._t_s,
                self._pose,
                (float(edges_rad[n, 0]), float(edges_rad[n, 1])),
                float(away_m[n]),
                math.hypot(BOX_PX / high_px, fraction),
                float(x1[n] - x0[n]) / high_px,
                0 if heights_px is None else nose_of(heights_px),
                are_hid[n],
                is_sure,
            )
            cars.append((detections.boxes_px[i], one))
        return cars

    def _assign(self, cars: Sequence[tuple[NDArray[np.float64], Observation]]) -> list[_Track]:
        """Assign boxes to tracks; the remaining boxes start new tracks.

        Boxes are matched to predicted boxes first, and the rest to the positions of standing cars.
        A box of low score only continues a track, at its predicted box, because the score of a
        distant or half hidden car falls below the threshold in every other frame.
        """
        moving = self._predicted(cars)
        used: set[int] = set()
        again: list[_Track] = []
        for pairs, sure in (
            (moving, True),
            (self._standing(cars, used), True),
            (moving, False),
        ):
            for _, i, j in sorted(pair for pair in pairs if cars[pair[1]][1].is_sure == sure):
                track = self._tracks[j]
                if i not in used and track.seen[-1].t_s < self._t_s:
                    used.add(i)
                    track.take(*cars[i], self._settings)
                    again.append(track)
        for i, (box, one) in enumerate(cars):
            if i not in used and one.is_sure:
                self._begun += 1
                self._tracks.append(
                    _Track(self._begun, box, np.zeros(4), [one], bytearray(numbers_of(one)))
                )
        return again

    def _predicted(
        self, cars: Sequence[tuple[NDArray[np.float64], Observation]]
    ) -> list[tuple[float, int, int]]:
        """Boxes that overlap a predicted box: cost, index of the box and of the track."""
        if not cars or not self._tracks:
            return []
        late_s = np.array([[self._t_s - track.seen[-1].t_s] for track in self._tracks])
        boxes_px = np.array([track.box_px for track in self._tracks])
        boxes_px += late_s * np.array([track.edges_pxps for track in self._tracks])
        overlap = box_ious(boxes_px[:, None], np.array([box for box, _ in cars]))
        last_m = np.array([track.seen[-1].distance_m for track in self._tracks])
        grown = np.array([one.distance_m for _, one in cars]) / last_m[:, None]
        is_same = (overlap > MIN_OVERLAP) & (grown > 1.0 / GROWTH) & (grown < GROWTH)
        return [(1.0 - float(overlap[j, i]), i, j) for j, i in np.argwhere(is_same).tolist()]

    def _standing(
        self, cars: Sequence[tuple[NDArray[np.float64], Observation]], used: set[int]
    ) -> Iterator[tuple[float, int, int]]:
        """Boxes that are left where a standing car would be, as ``_predicted``."""
        for j, track in enumerate(self._tracks):
            for i, (box, one) in enumerate(cars):
                if i not in used and one.is_sure and track.seen[-1].t_s < self._t_s:
                    away = _cost_standing(track, box, one)
                    if away < math.inf:
                        yield away, i, j


def past_within_m(camera: Camera, settings: Cars) -> float:
    """Return the maximum distance of oncoming and outgoing cars, in metres."""
    if settings.past_within_m is not None:
        return settings.past_within_m
    return max(PAST_WITHIN_M, (camera.focal_px or 0.0) * CAR_HEIGHT_M / FAR_PX)


def are_hidden(boxes_px: NDArray[np.float64], are_sure: NDArray[np.bool_]) -> list[bool]:
    """Mark the boxes, shape (N, 4), whose lower end is behind another car's box.

    On a road, the nearer car has the lower bottom edge. A box of low score hides no other, because
    it may be of the same car.
    """
    x0, y0, x1, y1 = boxes_px.T
    shared = np.minimum(x1[:, None], x1) - np.maximum(x0[:, None], x0)
    lower = y1 > (y1 + BOX_FRACTION * (y1 - y0))[:, None]
    is_covered = are_sure & lower & (y0 < y1[:, None]) & (shared > MAX_COVERED * (x1 - x0)[:, None])
    return [bool(one) for one in is_covered.any(axis=1)]


def _moved(axle: tuple[float, float, float], motion: CarStep) -> tuple[float, float, float]:
    """Pose of the rear axle after an arc."""
    x, y, heading = axle
    middle, way_m = heading + 0.5 * motion.turned_rad, motion.way_m or 0.0
    return (
        x + way_m * math.cos(middle),
        y + way_m * math.sin(middle),
        heading + motion.turned_rad,
    )


def _cost_standing(track: _Track, box_px: NDArray[np.float64], one: Observation) -> float:
    """Distance of a box from the position of a standing car, across the line of sight.

    It is infinite if the box cannot be the same car.
    """
    last = track.seen[-1]
    places = [place_of_end(last, side, one) for side in (0, 1)]
    ahead_m = 0.5 * (places[0][0] + places[1][0])
    if ahead_m <= 0.0:
        return math.inf
    fastest_m = FASTEST_MPS * (one.t_s - last.t_s) + 0.5
    grown = one.distance_m / ahead_m
    error = math.hypot(BOX_PX / float(box_px[3] - box_px[1]), BOX_FRACTION)
    limit = 2.0 * ERRORS * error + math.log1p(fastest_m / one.distance_m)
    if abs(math.log(grown)) > limit:
        return math.inf
    scale = one.distance_m / ahead_m
    right_m = [one.distance_m * math.tan(edge) for edge in one.edges_rad]
    off = [abs(at - place[1] * scale) for at, place in zip(right_m, places, strict=True)]
    return min(off) if min(off) <= fastest_m else math.inf
