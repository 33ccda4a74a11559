"""Openings of the carriageway: roads that leave it sideways, found in the accumulated plan view.

The carriageway's own edges are followed row by row from the car. An opening is a stretch of rows in
which one edge lies further out than the carriageway's by more than a lane, and behind which it
comes back or the road ends: the far kerb. It is relative to the carriageway and not to the path, so
opposite lanes are no opening. In a bend both edges go to the same side, which is no opening either.
An edge that is hidden, out of view or out of reach is not seen, which says nothing.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Floats

from .road_area import CELL_M, NEAREST_M, RoadPlan

# Fraction of the views above which a cell is road.
ROAD: Final = 0.5
# Distance by which an edge lies further out at an opening.
LANE_M: Final = 3.0
# Distance from the carriageway's edge to which a road is seen at least, unlike a lay-by.
DEPTH_M: Final = 5.0
# Distance from the expected edge within which it is the carriageway's own.
NEAR_EDGE_M: Final = 1.5
# Least and greatest length of an opening along the carriageway, and longest hidden part of it.
LENGTH_M: Final = (3.0, 40.0)
HIDDEN_M: Final = 4.0
# Rows ahead of the car from which the carriageway's edges are known, and min length of known edge.
KNOWN_BY_M: Final = 12.0
KNOWN_M: Final = 3.0
# Half the width around the expected middle in which the carriageway is found.
STARTS_M: Final = 3.0
# Road ahead of an intersection: its beginning and end beyond the far kerb, and half its width.
BEYOND_M: Final = (2.0, 12.0)
HALF_WIDTH_M: Final = 1.5
# Ahead of the car, rows whose edge must be known before a missing opening is one, and their share.
EXAMINED_M: Final = (2.0, 25.0)
EXAMINED: Final = 0.6
# Turn by which the car has left the road it was on, and distance without new openings after it.
TURNED_RAD: Final = 0.7
RESTS_M: Final = 25.0
# Distance within which openings of successive frames are one, frames that confirm it, and frames
# without it after which it is forgotten.
SAME_M: Final = 4.0
CONFIRMED: Final = 3
FORGOTTEN: Final = 5
# S.d. of an opening's corners, which are round, and of the pitch of a frame.
CORNER_SD_M: Final = 2.5
PITCH_SD_RAD: Final = 0.004


class Opening(NamedTuple):
    """A road that leaves the carriageway.

    Attributes:
        side: 1 for the left, -1 for the right.
        start_m: Distance of its near kerb ahead of the rear axle.
        end_m: Distance of its far kerb.
    """

    side: int
    start_m: float
    end_m: float


class Legs(NamedTuple):
    """What one frame's plan view says, 1 for seen, 0 for seen to be missing, NaN for not seen."""

    left: float
    straight: float
    right: float


class Seen(NamedTuple):
    """Result of one frame.

    Attributes:
        openings: Confirmed openings whose end is ahead.
        legs: Roads to the left, straight and to the right.
        start_m: Start of the intersection: the nearest near kerb; NaN without an opening.
        end_m: End of the intersection: the furthest far kerb.
        sd_m: Standard deviation of either.
    """

    openings: tuple[Opening, ...]
    legs: Legs
    start_m: float = math.nan
    end_m: float = math.nan
    sd_m: float = math.nan


class _Edge(NamedTuple):
    """One edge of the carriageway, by row.

    Attributes:
        out_m: Distance from the car's axis to the edge, outwards; NaN if no road was found.
        is_kerb: True where the cell behind it was seen and is no road.
        is_closed: True where the road ahead of the car has ended.
    """

    out_m: Floats
    is_kerb: NDArray[np.bool_]
    is_closed: NDArray[np.bool_]


@dataclass(slots=True)
class _Candidate:
    opening: Opening
    hits: int = 1
    missed: int = 0
    turned_rad: float = 0.0


@dataclass(slots=True)
class RoadOpenings:
    """Openings over the frames of a drive.

    Attributes:
        height_m: Height of the camera above the ground.
        nearest_m: Distance of the nearest ground in view ahead of the rear axle. An opening must
            begin with enough of it in view; beside the car, edges are only estimated anew.
    """

    height_m: float
    nearest_m: float = NEAREST_M
    _candidates: list[_Candidate] = field(default_factory=list)
    _rests_m: float = 0.0

    def __call__(
        self,
        plan: RoadPlan,
        moved_m: float,
        turned_rad: float = 0.0,
        sides: Collection[int] = (1, -1),
    ) -> Seen:
        """Process the next frame's plan view, after ``moved_m`` of travel and a turn.

        Openings to other sides than ``sides`` are followed, but neither seen nor missing.
        """
        edges = {side: _edge(plan, side) for side in (1, -1)}
        own = {side: _own_edge(plan, edges[side]) for side in (1, -1)}
        found: list[Opening] = []
        known: dict[int, bool] = {}
        for side in (1, -1):
            line, other = own[side], own[-side]
            known[side] = line is not None and _is_examined(plan, edges[side])
            if line is None:
                continue
            bend = None if other is None else edges[-side].out_m - _at(other, plan.ahead_m)
            found += _openings(plan, side, edges[side], _at(line, plan.ahead_m), bend)
        confirmed = self._followed(found, moved_m, turned_rad)
        for one in confirmed:
            known[one.side] &= one.side in sides
        return self._seen(plan, tuple(one for one in confirmed if one.side in sides), known)

    def restart(self) -> None:
        """Forget all openings."""
        self._candidates.clear()
        self._rests_m = 0.0

    def _followed(
        self, found: list[Opening], moved_m: float, turned_rad: float
    ) -> tuple[Opening, ...]:
        """Associate openings with earlier ones at the same place; return the confirmed ones."""
        self._rests_m -= abs(moved_m)
        for one in self._candidates:
            one.turned_rad += turned_rad
        if any(abs(one.turned_rad) > TURNED_RAD for one in self._candidates):
            self._candidates.clear()
            self._rests_m = RESTS_M
        for one in self._candidates:
            old = one.opening
            one.opening = old._replace(start_m=old.start_m - moved_m, end_m=old.end_m - moved_m)
            one.missed += 1
        for opening in found if self._rests_m <= 0.0 else ():
            same = [
                one
                for one in self._candidates
                if one.opening.side == opening.side
                and opening.start_m < one.opening.end_m + SAME_M
                and one.opening.start_m < opening.end_m + SAME_M
            ]
            if same:
                nearest = min(same, key=lambda one: abs(one.opening.start_m - opening.start_m))
                gain = 1.0 / min(nearest.hits + 1, 5)
                old = nearest.opening
                nearest.opening = Opening(
                    old.side,
                    old.start_m + gain * (opening.start_m - old.start_m),
                    old.end_m + gain * (opening.end_m - old.end_m),
                )
                nearest.hits += nearest.missed > 0
                nearest.missed = 0
            elif opening.end_m - max(opening.start_m, self.nearest_m) >= LENGTH_M[0]:
                self._candidates.append(_Candidate(opening))
        self._candidates = [
            one
            for one in self._candidates
            if one.opening.end_m > 0.0 and (one.missed <= FORGOTTEN or one.hits >= 2 * CONFIRMED)
        ]
        return tuple(one.opening for one in self._candidates if one.hits >= CONFIRMED)

    def _seen(self, plan: RoadPlan, openings: tuple[Opening, ...], known: dict[int, bool]) -> Seen:
        if not openings:
            sides = [0.0 if known[side] else math.nan for side in (1, -1)]
            return Seen((), Legs(sides[0], math.nan, sides[1]))
        first = min(openings, key=lambda one: one.start_m)
        here = [one for one in openings if one.start_m < first.end_m + SAME_M]
        end_m = max(one.end_m for one in here)
        legs = [
            1.0 if any(one.side == side for one in here) else 0.0 if known[side] else math.nan
            for side in (1, -1)
        ]
        by_pitch = max(end_m, 0.0) ** 2 * PITCH_SD_RAD / self.height_m
        return Seen(
            openings,
            Legs(legs[0], _straight(plan, end_m), legs[1]),
            first.start_m,
            end_m,
            math.hypot(CORNER_SD_M, by_pitch),
        )


def _edge(plan: RoadPlan, side: int) -> _Edge:
    """Follow the road outwards from the car's axis in each row."""
    left_m = plan.left_m if side == 1 else -plan.left_m[::-1]
    middle, around = int(np.argmin(np.abs(left_m))), round(STARTS_M / CELL_M)
    # Cells further inwards than the carriageway is searched for do not count.
    road = (plan.road if side == 1 else plan.road[:, ::-1])[:, : middle + around + 1]
    is_road = np.ascontiguousarray(road > ROAD)
    # The nearest road to the car's axis, of two the outer one.
    aside = np.array(sorted(range(-around, around + 1), key=abs))
    near = is_road.take(middle + aside, axis=1)
    nearest, rows = near.argmax(axis=1), np.arange(len(road))
    starts = middle + aside.take(nearest)
    # The edge is the last cell before the next one that ends the road. A gap of one cell is noise.
    ends = ~is_road
    ends[:, 2:] &= ~is_road[:, 1:-1]
    ends &= np.arange(road.shape[1]) < starts[:, None]
    last = road.shape[1] - 1 - ends[:, ::-1].argmax(axis=1)
    last = np.where(ends[rows, last], last, -1)
    has_road = near[rows, nearest]
    out_m = np.where(has_road, left_m[last + 1] + 0.5 * CELL_M, np.nan)
    is_kerb = has_road & (last >= 0) & np.isfinite(road[rows, last])
    span = np.isfinite(road[:, middle - around // 2 : middle + around // 2 + 1])
    is_closed = ~has_road & (np.add.reduce(span, axis=1) > 0.8 * span.shape[1])
    return _Edge(out_m, is_kerb, is_closed)


def _is_examined(plan: RoadPlan, edge: _Edge) -> bool:
    """Return whether enough of an edge is seen ahead for its openings to be missed by none."""
    rows = (plan.ahead_m > EXAMINED_M[0]) & (plan.ahead_m < EXAMINED_M[1])
    return bool(edge.is_kerb[rows].mean() >= EXAMINED)


def _own_edge(plan: RoadPlan, edge: _Edge) -> tuple[float, float] | None:
    """Offset and slope of the carriageway's own edge near the car; None if it is not seen."""
    near = edge.is_kerb & (plan.ahead_m < KNOWN_BY_M)
    if near.sum() * CELL_M < KNOWN_M:
        return None
    x, y = plan.ahead_m[near], edge.out_m[near]
    slopes = np.linspace(-0.2, 0.2, 17)
    away = y - slopes[:, None] * x
    # The offset that most rows share.
    is_same = np.abs(away[:, :, None] - away[:, None, :]) < 0.5
    counts = is_same.sum(axis=1)
    best = int(np.argmax(counts.max(axis=1) - 20.0 * np.abs(slopes)))
    offset = np.median(away[best][is_same[best][:, counts[best].argmax()]])
    return float(offset), float(slopes[best])


def _at(line: tuple[float, float], ahead_m: Floats) -> Floats:
    return line[0] + line[1] * ahead_m


def _openings(
    plan: RoadPlan, side: int, edge: _Edge, own_m: Floats, bend_m: Floats | None
) -> list[Opening]:
    """Stretches in which an edge leaves the carriageway's own and comes back."""
    beyond_m = edge.out_m - own_m
    with np.errstate(invalid="ignore"):
        is_out = beyond_m > LANE_M
        is_back = edge.is_closed | (edge.is_kerb & (beyond_m < NEAR_EDGE_M))
        if bend_m is not None:
            # In a bend the other edge comes inwards.
            is_out &= ~(bend_m < -NEAR_EDGE_M)
    found: list[Opening] = []
    start, last_out, last_own = None, 0, 0
    for row in range(len(beyond_m)):
        if is_out[row]:
            if start is None:
                start = max(last_own, row - round(HIDDEN_M / CELL_M))
            last_out = row
        elif is_back[row]:
            if start is not None:
                rows = slice(start, row)
                length_m = (row - start) * CELL_M
                out_m = is_out[rows].sum() * CELL_M
                depth_m = float(np.nanmax(beyond_m[rows]))
                is_long = LENGTH_M[0] <= length_m <= LENGTH_M[1] and out_m >= LENGTH_M[0]
                if is_long and depth_m >= DEPTH_M:
                    found.append(
                        Opening(
                            side,
                            float(plan.ahead_m[start] + 0.5 * CELL_M),
                            float(plan.ahead_m[row] - 0.5 * CELL_M),
                        )
                    )
                start = None
            last_own = row
        elif start is not None and (row - last_out) * CELL_M > HIDDEN_M:
            # Hidden for too long: where it ends is not seen.
            start = None
    return found


def _straight(plan: RoadPlan, end_m: float) -> float:
    """Whether the road goes on beyond the far kerb; NaN if that is not seen."""
    rows = (plan.ahead_m > end_m + BEYOND_M[0]) & (plan.ahead_m < end_m + BEYOND_M[1])
    columns = np.abs(plan.left_m) < HALF_WIDTH_M
    part = plan.road[np.ix_(rows, columns)]
    if part.size == 0 or np.isfinite(part).mean() < 0.5 or rows.sum() * CELL_M < LENGTH_M[0]:
        return math.nan
    share = float((part[np.isfinite(part)] > ROAD).mean())
    return 1.0 if share > 0.6 else 0.0 if share < 0.2 else math.nan
