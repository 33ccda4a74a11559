"""Road area accumulated on the ground along the driven path, in cells of a quarter of a metre.

Each frame's road mask is projected to level ground with the camera's height and attitude. A cell
holds the weighted mean of its views: nearer views weigh more, by the inverse square of the
distance, because one row of the mask then covers less ground. Cells behind vehicles are not seen
in that frame. The grid is fixed to the ground and moves on in whole cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import RoadMask
from crosscue.detectors.ranging.ground_plane import GroundPlane, Mounted, turned
from crosscue.replay.columns import Floats

CELL_M: Final = 0.25
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


def reach_of(camera: Mounted, road: RoadMask) -> float:
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

    camera: Mounted
    reach_m: float
    _road: NDArray[np.float32] = field(init=False)
    _seen: NDArray[np.float32] = field(init=False)
    _xy_m: Floats = field(init=False)
    _heading: float = 0.0

    def __post_init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget everything."""
        self._road = np.zeros((CELLS, CELLS), np.float32)
        self._seen = np.zeros((CELLS, CELLS), np.float32)
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
        is_road = road.pixels()
        rows, columns, ground_m = self._ahead()
        plane = GroundPlane.of(self.camera, road.size_px)
        to_car = turned(self.camera.yaw_rad, pitch_rad, self.camera.roll_rad)
        plane = GroundPlane(plane.focal_px, plane.center_px, plane.position_m, to_car)
        with np.errstate(invalid="ignore"):
            x, y = np.nan_to_num(plane.project(ground_m), nan=-1.0).T
        width, height = road.size_px
        in_view = (x >= 0.0) & (x < width) & (y >= 0.0) & (y < height)
        for x0, y0, x1, y1 in boxes_px.tolist():
            aside, above = MARGIN * (x1 - x0), MARGIN * (y1 - y0)
            in_view &= ~((x > x0 - aside) & (x < x1 + aside) & (y > y0) & (y < y1 + above))
        rows, columns, x, y, ground_m = (one[in_view] for one in (rows, columns, x, y, ground_m))
        mask_width, mask_height = road.mask_size_px
        found = is_road[
            (y * mask_height / height).astype(int), (x * mask_width / width).astype(int)
        ]
        away_m = np.hypot(ground_m[:, 0] - self.camera.x_m, ground_m[:, 1] - self.camera.y_m)
        weight = np.minimum(1.0, (SHARP_M / np.maximum(away_m, 1.0)) ** 2).astype(np.float32)
        self._road[rows, columns] += weight * found
        self._seen[rows, columns] += weight

    def plan(self, behind_m: float = 10.0, min_weight: float = 0.05) -> RoadPlan:
        """Return the plan view in the car's axes.

        Args:
            behind_m: Length behind the rear axle.
            min_weight: Weight below which a cell is not seen.
        """
        ahead_m = np.arange(-behind_m, self.reach_m + self.camera.x_m, CELL_M) + 0.5 * CELL_M
        left_m = np.arange(ASIDE_M, -ASIDE_M, -CELL_M) - 0.5 * CELL_M
        x, y = np.meshgrid(ahead_m, left_m, indexing="ij")
        cos, sin = math.cos(self._heading), math.sin(self._heading)
        i = self._index(self._xy_m[0] + x * cos - y * sin)
        j = self._index(self._xy_m[1] + x * sin + y * cos)
        seen = self._seen[i, j]
        share = self._road[i, j] / np.maximum(seen, 1e-9)
        return RoadPlan(ahead_m, left_m, np.where(seen >= min_weight, share, np.nan))

    def _ahead(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
        """Cells in reach: their rows and columns, and their middles in the car's axes."""
        reach_m = self.reach_m + abs(self.camera.x_m)
        cos, sin = math.cos(self._heading), math.sin(self._heading)
        middle = (
            self._index(self._xy_m[0] + 0.5 * reach_m * cos),
            self._index(self._xy_m[1] + 0.5 * reach_m * sin),
        )
        around = math.ceil(math.hypot(0.5 * reach_m, ASIDE_M) / CELL_M)
        i, j = (np.arange(max(int(at) - around, 0), min(int(at) + around, CELLS)) for at in middle)
        rows, columns = (one.ravel() for one in np.meshgrid(i, j, indexing="ij"))
        dx = (rows + 0.5) * CELL_M - HALF_M - self._xy_m[0]
        dy = (columns + 0.5) * CELL_M - HALF_M - self._xy_m[1]
        x, y = dx * cos + dy * sin, dy * cos - dx * sin
        in_reach = (x > NEAREST_M + self.camera.x_m) & (x < reach_m) & (np.abs(y) < ASIDE_M)
        return rows[in_reach], columns[in_reach], np.column_stack([x, y])[in_reach]

    def _index(self, at_m: Floats | float) -> NDArray[np.int64]:
        index = np.floor((np.asarray(at_m) + HALF_M) / CELL_M).astype(np.int64)
        return np.clip(index, 0, CELLS - 1)


def _shifted(grid: NDArray[np.float32], cells: NDArray[np.int64]) -> NDArray[np.float32]:
    """Grid whose cell (i, j) is the old (i + cells[0], j + cells[1]); new cells are zero."""
    new = np.zeros_like(grid)
    source, target = [], []
    for shift in cells.tolist():
        source.append(slice(max(shift, 0), CELLS + min(shift, 0)))
        target.append(slice(max(-shift, 0), CELLS + min(-shift, 0)))
    new[tuple(target)] = grid[tuple(source)]
    return new
