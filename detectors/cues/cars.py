"""Crossing and parked cars from masks in two consecutive frames (eq. 15, 16).

A car seen from the side is longer than twice its height. Detections in two frames are the same car
if mask area and position hardly change. Its motion distinguishes the two cues: a car that moves
sideways is cross traffic, and one that does not move is parked. The nose of a parked car is the
lower end of its mask.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import Detections
from crosscue.replay.vehicle.vehicle import Cars, CueSpec, Vehicle

from .candidates import (
    BELOW_SCORE,
    CUT_OR_FAR,
    ELSEWHERE,
    NOT_FOUND_BEFORE,
    NOT_FROM_THE_SIDE,
    NOT_PAST,
    OTHER_MOTION,
    TOO_FEW_FRAMES,
    Count,
)
from .observed import NONE, CarCounts, Sides, nose_of, of_side


@dataclass(frozen=True, slots=True, eq=False)
class CarShapes:
    """Cars of one frame that pass the rules of shape and score, as columns of length N.

    Attributes:
        t_ns: Log time.
        size_px: Width and height of the picture.
        center_px: Shape (N, 2), float64: centre of the box.
        area_px: Shape (N,), float64: area of the mask, or of the box without a mask.
        nose: Shape (N,), int64: -1 for a nose at the left, 1 at the right, 0 unknown.
    """

    t_ns: int
    size_px: tuple[int, int]
    center_px: NDArray[np.float64]
    area_px: NDArray[np.float64]
    nose: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.area_px)


class CarCandidates(NamedTuple):
    """All cars among the detections of a frame.

    Attributes:
        scores: Score of each.
        low: Number of those whose score is too low.
        thresholds: Scores that they had to exceed.
        shapes: Number of those that pass the rules of shape and score.
    """

    scores: Sequence[float] = ()
    low: int = 0
    thresholds: Sequence[float] = ()
    shapes: int = 0


NO_CARS: Final = CarCandidates()


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Cars that were found in two consecutive frames, as columns of length M.

    Attributes:
        step_px: Shape (M, 2), float64: displacement of the box centres.
        center_px: Shape (M, 2), float64: box centres in the later frame.
        nose: Shape (M,), int64: as in ``CarShapes``, in the later frame.
        width_px: Width of the picture.
        judged: Counts of cars, if they were tracked over more than these two frames.
        cars: Candidates among the detections of the later frame.
        is_first: True without an earlier frame, where no count is known.
    """

    step_px: NDArray[np.float64]
    center_px: NDArray[np.float64]
    nose: NDArray[np.int64]
    width_px: int
    judged: CarCounts | None = None
    cars: CarCandidates = NO_CARS
    is_first: bool = False


def car_shapes(found: Sequence[Detections], settings: Cars) -> CarShapes:
    """Select the cars of one frame that are seen from the side (eq. 15: length over height, score).

    Args:
        found: One or more detectors' results for the frame.
        settings: Labels, score and shape.

    Raises:
        ValueError: ``found`` is empty, or a mask is damaged.
    """
    if not found:
        raise ValueError("found: expected at least one detector's result")
    t_ns, size = found[0].t_ns, found[0].size_px
    rows = [
        (box, detections.column_heights_px(i))
        for detections in found
        for i, (label, is_sure, box) in enumerate(
            zip(
                detections.labels,
                detections.are_sure(settings.score).tolist(),
                detections.boxes_px.tolist(),
                strict=True,
            )
        )
        if label in settings.labels and is_sure and _is_long(box, settings)
    ]
    boxes = np.array([box for box, _ in rows], np.float64).reshape(-1, 4)
    # Column heights yield both area and nose from a single decoding of the runs.
    areas = [
        (box[2] - box[0]) * (box[3] - box[1]) if columns is None else float(columns.sum())
        for box, columns in rows
    ]
    noses = [0 if columns is None else nose_of(columns) for _, columns in rows]
    center = (boxes[:, :2] + boxes[:, 2:]) / 2.0
    return CarShapes(t_ns, size, center, np.array(areas), np.array(noses, np.int64))


def _is_long(box: Sequence[float], settings: Cars) -> bool:
    x0, y0, x1, y1 = box
    return x1 - x0 > settings.length_per_height * (y1 - y0)


def pair_cars(before: CarShapes, now: CarShapes, settings: Cars) -> Pairs:
    """Pair cars of two frames whose areas and positions hardly differ, nearest pairs first.

    Frames of different size, out of order or too far apart have no pairs.
    """
    gap_s = (now.t_ns - before.t_ns) * 1e-9
    width = now.size_px[0]
    if not 0.0 < gap_s <= settings.max_gap_s or before.size_px != now.size_px:
        return no_pairs(width)
    steps = now.center_px[None, :, :] - before.center_px[:, None, :]
    distance = np.hypot(steps[:, :, 0], steps[:, :, 1])
    change = np.abs(now.area_px[None, :] - before.area_px[:, None]) / before.area_px[:, None]
    fits = (change < settings.area_change) & (distance < settings.position_change * width)
    if not fits.any():
        return no_pairs(width)
    first, second = _nearest(np.where(fits, distance, np.inf))
    return Pairs(steps[first, second], now.center_px[second], now.nose[second], width)


def no_pairs(width_px: int) -> Pairs:
    """Return empty pairs, for two frames without a common car."""
    return Pairs(np.empty((0, 2)), np.empty((0, 2)), np.empty(0, np.int64), width_px)


def _nearest(cost: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the smallest finite entries, each row and column at most once."""
    rows, columns = np.nonzero(np.isfinite(cost))
    pairs = zip(cost[rows, columns].tolist(), rows.tolist(), columns.tolist(), strict=True)
    kept: list[tuple[int, int]] = []
    for _, row, column in sorted(pairs):
        if all(row != r and column != c for r, c in kept):
            kept.append((row, column))
    first, second = np.array(kept).T
    return first, second


def cross_traffic(pairs: Pairs, settings: Cars) -> Sides:
    """Count cars that move to the left and to the right, horizontally and by enough (eq. 15)."""
    if not len(pairs.nose):
        return NONE
    x, y = pairs.step_px[:, 0], pairs.step_px[:, 1]
    min_step_px = settings.still_change * pairs.width_px
    is_moving = (np.abs(x) > min_step_px) & (np.abs(y) <= settings.slope * np.abs(x))
    return Sides(int(np.sum(is_moving & (x < 0))), int(np.sum(is_moving & (x > 0))))


def parked_cars(pairs: Pairs, settings: Cars) -> Sides:
    """Count standing cars that face left and right (eq. 16); cars of unknown nose do not count."""
    if not len(pairs.nose):
        return NONE
    min_step_px = settings.still_change * pairs.width_px
    is_still = (np.abs(pairs.step_px) <= min_step_px).all(axis=1)
    return Sides(int(np.sum(is_still & (pairs.nose < 0))), int(np.sum(is_still & (pairs.nose > 0))))


def count_crossing(pairs: Pairs, vehicle: Vehicle, cue: CueSpec) -> Count:
    """Count cars that cross towards the side that the cue supports."""
    if pairs.judged is None:
        return _of_pairs(pairs, of_side(cross_traffic(pairs, vehicle.cars), cue))
    judged = pairs.judged
    return _followed(pairs, of_side(judged.crossing, cue), of_side(judged.crossing_elsewhere, cue))


def count_parked(pairs: Pairs, vehicle: Vehicle, cue: CueSpec) -> Count:
    """Count parked cars that face the side that the cue supports."""
    if pairs.judged is None:
        return _of_pairs(pairs, of_side(parked_cars(pairs, vehicle.cars), cue))
    judged = pairs.judged
    return _followed(pairs, of_side(judged.parked, cue), of_side(judged.parked_elsewhere, cue))


def count_oncoming(pairs: Pairs, vehicle: Vehicle, cue: CueSpec) -> Count | None:
    """Count oncoming cars past the intersection; None where unknown."""
    past = None if pairs.judged is None else pairs.judged.past
    return None if past is None else _past(pairs, past.oncoming)


def count_outgoing(pairs: Pairs, vehicle: Vehicle, cue: CueSpec) -> Count | None:
    """Count outgoing cars past the intersection; None where unknown."""
    past = None if pairs.judged is None else pairs.judged.past
    return None if past is None else _past(pairs, past.outgoing)


def count_in_leg(pairs: Pairs, vehicle: Vehicle, cue: CueSpec) -> Count | None:
    """Count cars that move in the leg that the cue supports; None where unknown or not wanted."""
    legs = None if pairs.judged is None else pairs.judged.in_leg
    if legs is None or not vehicle.cars.leg_traffic:
        return None
    number = of_side(legs, cue)
    skipped = {BELOW_SCORE: pairs.cars.low}
    skipped[ELSEWHERE] = len(pairs.cars.scores) - pairs.cars.low - number
    return _count(pairs.cars, number, skipped)


def _of_pairs(pairs: Pairs, number: int) -> Count:
    """Return a count of cars in two frames; a car is skipped for the first rule that it fails."""
    cars, again = pairs.cars, len(pairs.nose)
    skipped = {
        BELOW_SCORE: cars.low,
        NOT_FROM_THE_SIDE: len(cars.scores) - cars.low - cars.shapes,
        NOT_FOUND_BEFORE: cars.shapes - again,
        OTHER_MOTION: again - min(number, again),
    }
    return _count(cars, None if pairs.is_first else number, skipped)


def _followed(pairs: Pairs, here: int, there: int) -> Count:
    """Return a count of tracked cars at the intersection, of which others are elsewhere."""
    cars, judged = pairs.cars, pairs.judged
    assert judged is not None
    skipped = {
        BELOW_SCORE: cars.low,
        CUT_OR_FAR: len(cars.scores) - cars.low - judged.seen,
        TOO_FEW_FRAMES: judged.seen - judged.followed,
        OTHER_MOTION: judged.followed - here - there,
        ELSEWHERE: there,
    }
    return _count(cars, here, skipped)


def _past(pairs: Pairs, number: int) -> Count:
    cars = pairs.cars
    skipped = {BELOW_SCORE: cars.low, NOT_PAST: len(cars.scores) - cars.low - number}
    return _count(cars, number, skipped)


def _count(cars: CarCandidates, number: int | None, skipped: Mapping[str, int]) -> Count:
    return Count(number, cars.scores, skipped, cars.thresholds, "[cars] score")
