"""Road area accumulated on the ground along the driven path, in cells of a quarter of a metre.

Each frame's road mask is projected to level ground with the camera's height and attitude. A cell
holds the weighted mean of its views: nearer views weigh more, by the inverse square of the
distance, because one row of the mask then covers less ground. Cells behind vehicles are not seen
in that frame. What stands beside the road hides the ground behind it, so a view past its edge says
little: there is no road on the wall of a house, but perhaps in the side street behind. The grid is
fixed to the ground and moves on in whole cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors import rle
from crosscue.detectors.base import RoadMask
from crosscue.detectors.ranging.ground_plane import GroundPlane, turned
from crosscue.replay.columns import Floats
from crosscue.replay.vehicle.camera import Camera

CELL_M: Final = 0.25
# Fractions of a cell in which places are added, as a power of 2: whole numbers are added in a third
# of the time.
FRACTIONS: Final = 20
# Half of the side of the square grid.
HALF_M: Final = 70.0
CELLS: Final = round(2 * HALF_M / CELL_M)
# Distance from the middle at which the grid moves on.
MOVES_M: Final = 15.0
# Ground that is examined: nearest and furthest distance ahead of the camera, and to either side.
NEAREST_M: Final = 4.0
ASIDE_M: Final = 25.0
# Ground that a row of the mask covers at the reach, and greatest reach.
ROW_M: Final = 1.5
REACH_M: Final = 50.0
# Distance within which a view has the full weight.
SHARP_M: Final = 10.0
# Margin around vehicles, as a fraction of the box, behind which the ground counts as hidden.
MARGIN: Final = 0.05
# Ground beyond an edge of the road that is seen with it, such as a kerb and a footway, and the
# weight of views of no road further behind it.
BESIDE_M: Final = 2.0
BEHIND: Final = 0.1
# What a pixel of a mask shows, and its weight.
HIDDEN, SHOWS_GROUND, SHOWS_ROAD, SHOWS_BEHIND = 0, 1, 2, 3
WEIGHTS: Final = np.array([0.0, 1.0, 1.0, BEHIND], np.float32)


def reach_of(camera: Camera, road: RoadMask) -> float:
    """Distance up to which rows of a mask tell ground apart; 0 without a focal length."""
    focal_px = (camera.focal_px or 0.0) * road.mask_size_px[0] / road.size_px[0]
    return min(math.sqrt(max(ROW_M * camera.z_m * focal_px, 0.0)), REACH_M)


class RoadPlan(NamedTuple):
    """Plan view relative to the car: rows ahead, columns from left to right.

    Attributes:
        ahead_m: Shape (R,): distance of each row ahead of the rear axle.
        left_m: Shape (C,): distance of each column to the left, decreasing.
        road: Shape (R, C): fraction of the views that show road; NaN where not seen.
    """

    ahead_m: Floats
    left_m: Floats
    road: Floats


@dataclass(slots=True)
class RoadArea:
    """The accumulated road.

    Attributes:
        camera: Mounting and intrinsics.
        reach_m: Distance up to which masks are used.
    """

    camera: Camera
    reach_m: float
    _road: NDArray[np.float32] = field(init=False)
    _seen: NDArray[np.float32] = field(init=False)
    _xy_m: Floats = field(init=False)
    _scratch: NDArray[np.float32] = field(init=False)
    _heading: float = 0.0

    def __post_init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget everything."""
        self._road = np.zeros((CELLS, CELLS), np.float32)
        self._seen = np.zeros((CELLS, CELLS), np.float32)
        self._scratch = np.empty((6, CELLS * CELLS), np.float32)
        self._xy_m = np.zeros(2)
        self._heading = 0.0

    def move(self, distance_m: float, turn_rad: float) -> None:
        """Follow the car along the chord of its turn."""
        chord = self._heading + 0.5 * turn_rad
        self._xy_m = self._xy_m + distance_m * np.array([math.cos(chord), math.sin(chord)])
        self._heading += turn_rad
        cells = np.round(self._xy_m / CELL_M).astype(int)
        if np.abs(self._xy_m).max() > MOVES_M:
            self._road = _shifted(self._road, cells)
            self._seen = _shifted(self._seen, cells)
            self._xy_m = self._xy_m - CELL_M * cells

    def see(self, road: RoadMask, boxes_px: Floats, pitch_rad: float) -> None:
        """Add one frame.

        Args:
            road: The mask.
            boxes_px: Shape (N, 4): boxes of vehicles, behind which the ground is hidden.
            pitch_rad: Pitch of the camera relative to the road.

        Raises:
            ValueError: The mask is damaged.
        """
        rows, columns, dx_m, dy_m = self._ahead()
        cos, sin = math.cos(self._heading), math.sin(self._heading)
        camera, (width, height) = self.camera, road.size_px
        # Arrays of the grid's size are used again, as memory of that size is slow to get.
        held = self._scratch[:, : len(dx_m) * len(dy_m)].reshape(-1, len(dx_m), len(dy_m))
        ahead_m, left_m, scale, x, y, weight = held

        def sums(ahead: float, left: float, up: float, *, out: NDArray[np.float32]) -> None:
            """Weighted sum of each cell's place from the camera."""
            along = (ahead * cos - left * sin) * dx_m - ahead * camera.x_m - left * camera.y_m
            across = (ahead * sin + left * cos) * dy_m - up * camera.z_m
            np.add(along.astype(np.float32)[:, None], across.astype(np.float32), out=out)

        sums(1.0, 0.0, 0.0, out=ahead_m)
        sums(0.0, 1.0, 0.0, out=left_m)
        in_reach = (ahead_m > NEAREST_M) & (ahead_m < self._far_m - camera.x_m)
        in_reach &= np.abs(np.add(left_m, camera.y_m, out=x), out=x) < ASIDE_M
        # Ground in the camera's axes, forward, left and up, and in pixels of the mask.
        forward, left, up = turned(camera.yaw_rad, pitch_rad, camera.roll_rad).T.tolist()
        plane = GroundPlane.of(camera, road.size_px)
        mask_width, mask_height = road.mask_size_px
        across, down = mask_width / width, mask_height / height
        sums(*forward, out=scale)
        np.divide(-plane.focal_px, np.maximum(scale, 1e-3, out=scale), out=scale)
        # A border stands for everything out of the picture.
        for axis, at, size, center_px, per_px in (
            (left, x, mask_width, plane.center_px[0], across),
            (up, y, mask_height, plane.center_px[1], down),
        ):
            sums(*axis, out=at)
            at *= np.multiply(scale, per_px, out=weight)
            at += center_px * per_px + 1.0
            np.clip(at, 0.0, size + 1.0, out=at)
        # Rows above the ground in reach show nothing that counts.
        weight.fill(mask_height)
        np.copyto(weight, y, where=in_reach)
        top = min(max(int(weight.min()) - 1, 0), mask_height - 1)
        rows_px = (np.arange(mask_height) + 0.5) / down - plane.center_px[1]
        below = plane.focal_px * math.sin(pitch_rad) + rows_px * math.cos(pitch_rad)
        above_px = plane.focal_px * math.cos(pitch_rad) - rows_px * math.sin(pitch_rad)
        away_m = camera.z_m * above_px / np.maximum(below, 1e-3)
        shown = _shown(road, boxes_px * [across, down, across, down], away_m, top)
        cells = x.astype(np.int32)
        cells *= shown.shape[1]
        cells += np.maximum(y.astype(np.int32) - top, 0)
        found = shown.take(cells, mode="clip")
        np.multiply(ahead_m, ahead_m, out=weight)
        weight += np.multiply(left_m, left_m, out=x)
        np.divide(SHARP_M**2, np.maximum(weight, SHARP_M**2, out=weight), out=weight)
        weight *= WEIGHTS.take(found, out=x, mode="clip")
        weight *= in_reach
        self._seen[rows, columns] += weight
        weight *= found == SHOWS_ROAD
        self._road[rows, columns] += weight

    def plan(self, behind_m: float = 10.0, min_weight: float = 0.05) -> RoadPlan:
        """Return the plan view in the car's axes.

        Args:
            behind_m: Length behind the rear axle.
            min_weight: Weight below which a cell is not seen.
        """
        ahead_m = np.arange(-behind_m, self.reach_m + self.camera.x_m, CELL_M) + 0.5 * CELL_M
        left_m = np.arange(ASIDE_M, -ASIDE_M, -CELL_M) - 0.5 * CELL_M
        cos, sin = math.cos(self._heading), math.sin(self._heading)
        x, y = self._xy_m
        cells = _cells(x + ahead_m * cos, -left_m * sin)
        cells *= CELLS
        cells += _cells(y + ahead_m * sin, left_m * cos)
        places = cells.astype(np.intp)
        seen, road = (grid.take(places, mode="clip") for grid in (self._seen, self._road))
        is_seen = seen >= min_weight
        # 0 / 0 is NaN; that takes a third of the time of a choice by cell.
        seen *= is_seen
        road *= is_seen
        with np.errstate(invalid="ignore"):
            return RoadPlan(ahead_m, left_m, np.divide(road, seen, out=road))

    @property
    def _far_m(self) -> float:
        return self.reach_m + abs(self.camera.x_m)

    def _ahead(self) -> tuple[slice, slice, Floats, Floats]:
        """Part of the grid around the ground in reach, and its cells' middles from the car."""
        cos, sin = math.cos(self._heading), math.sin(self._heading)
        corners = [(x, y) for x in (0.0, self._far_m) for y in (-ASIDE_M, ASIDE_M)]
        away_m = ([x * cos - y * sin for x, y in corners], [x * sin + y * cos for x, y in corners])
        parts, middles_m = [], []
        for at_m, corners_m in zip(self._xy_m.tolist(), away_m, strict=True):
            first, last = (
                min(max(int((at_m + off_m + HALF_M) / CELL_M), 0), CELLS - 1)
                for off_m in (min(corners_m), max(corners_m))
            )
            parts.append(slice(first, last + 1))
            middles_m.append((np.arange(first, last + 1) + 0.5) * CELL_M - HALF_M - at_m)
        return parts[0], parts[1], middles_m[0], middles_m[1]


def _cells(along_m: Floats, across_m: Floats) -> NDArray[np.int32]:
    """Rows or columns of the grid at the sums of two places, in whole fractions of a cell."""
    along = np.rint((along_m + HALF_M) * (2**FRACTIONS / CELL_M)).astype(np.int32)
    across = np.rint(across_m * (2**FRACTIONS / CELL_M)).astype(np.int32)
    found = np.add.outer(along, across)
    found >>= FRACTIONS
    return np.clip(found, 0, CELLS - 1, out=found)


def _shown(road: RoadMask, boxes_px: Floats, away_m: Floats, top: int = 0) -> NDArray[np.uint8]:
    """What pixels show: columns of the mask, with a border of one pixel.

    Args:
        road: The mask.
        boxes_px: Shape (N, 4): boxes of vehicles in its pixels.
        away_m: Distance of level ground by row.
        top: Number of rows at the top to leave out.
    """
    width, height = road.mask_size_px
    # Runs of pixels end at the end of their column, too. Places are doubled; odd ones turn to road
    # or back.
    turns = 2 * rle.checked_runs(road.mask, road.mask_size_px).cumsum()[:-1] + 1
    keys = np.concatenate([turns, 2 * height * np.arange(width)])
    # A stable sort merges the two parts, which are sorted, in a twentieth of the time.
    keys.sort(kind="stable")
    starts, is_road = keys >> 1, (keys & 1).cumsum() & 1 > 0
    first = starts % height
    stop = first + np.append(starts[1:], width * height) - starts
    # For each end of a run without road, first row that is not too far behind it.
    falling_m = np.maximum.accumulate(away_m[::-1])[::-1]
    until = np.searchsorted(BESIDE_M - np.minimum.accumulate(away_m), -falling_m)
    behind = np.where(is_road, 0, until.take(stop - 1))
    edges = np.maximum([first, np.minimum(np.maximum(behind, first), stop), stop], top)
    lengths = (edges[1:] - edges[:-1]).T
    kinds = np.full(lengths.shape, SHOWS_BEHIND, np.uint8)
    kinds[:, 1] = np.where(is_road, SHOWS_ROAD, SHOWS_GROUND)
    framed = np.zeros((width + 2, height - top + 2), np.uint8)
    shown = framed[1:-1, 1:-1]
    shown[:] = np.repeat(kinds.ravel(), lengths.ravel()).reshape(shown.shape)
    margin = MARGIN * (boxes_px[:, 2:] - boxes_px[:, :2])
    widened = boxes_px + np.column_stack([-margin[:, 0], 0.0 * margin[:, 0], margin])
    for x0, y0, x1, y1 in np.maximum(np.rint(widened).astype(int) - [0, top, 0, top], 0).tolist():
        shown[x0:x1, y0:y1] = HIDDEN
    return framed


def _shifted(grid: NDArray[np.float32], cells: NDArray[np.int64]) -> NDArray[np.float32]:
    """Grid whose cell (i, j) is the old (i + cells[0], j + cells[1]); new cells are zero."""
    new = np.zeros_like(grid)
    source, target = [], []
    for shift in cells.tolist():
        source.append(slice(max(shift, 0), CELLS + min(shift, 0)))
        target.append(slice(max(-shift, 0), CELLS + min(-shift, 0)))
    new[tuple(target)] = grid[tuple(source)]
    return new
