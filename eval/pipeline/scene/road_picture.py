"""The accumulated road and its openings as shapes in metres, and as a picture from above."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.cues.road_area import CELL_M, RoadPlan
from crosscue.detectors.cues.road_openings import ROAD, Seen
from crosscue.eval.pipeline.scene.roads import Roads, pitches_of
from crosscue.eval.pipeline.scene.stage import EgoMotion, Restarts
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.tables.stored_frames import stored_frames
from crosscue.eval.runs.tables.travelled import odometer_of
from crosscue.replay.columns import Bytes

# Distance of the lines of a hatched plan, and width of an opening that is drawn.
HATCH_M: Final = 1.0
OPENING_M: Final = 8.0
# Blue, green, red of a cell: road, seen and no road, not seen; and of lines.
COLOURS: Final = ((90, 160, 60), (70, 60, 120), (60, 60, 60))
LINE: Final = (230, 230, 230)
OPENING: Final = (60, 220, 250)
# Pixels of a cell.
SCALE: Final = 2


def plan_lines(plan: RoadPlan) -> list[NDArray[np.float64]]:
    """Return runs of road across the car's axis, as lines of x to the right and y backwards."""
    every = round(HATCH_M / CELL_M)
    rows = plan.road[::every] > ROAD
    padded = np.zeros((len(rows), rows.shape[1] + 2), np.int8)
    padded[:, 1:-1] = rows
    at, columns = np.nonzero(np.diff(padded, axis=1))
    right_m = -(plan.left_m[0] + 0.5 * CELL_M) + CELL_M * columns
    points = np.stack([right_m, -plan.ahead_m[::every][at]], axis=1)
    return list(points.reshape(-1, 2, 2))


def opening_lines(seen: Seen) -> list[tuple[NDArray[np.float64], str]]:
    """Return the near and the far kerb of each opening, in the same axes, with a label."""
    found = []
    for one in seen.openings:
        inner, outer = -one.side * 1.0, -one.side * OPENING_M
        corners = [(inner, -one.start_m), (outer, -one.start_m), (outer, -one.end_m)]
        line = np.array([*corners, (inner, -one.end_m)], np.float64)
        side = "left" if one.side == 1 else "right"
        found.append((line, f"road {side}, {one.end_m - one.start_m:.0f} m wide"))
    return found


def draw_plan(plan: RoadPlan, seen: Seen | None) -> Bytes:
    """Draw the plan view, the car's axis upwards: road green, other ground red, unseen grey."""
    import cv2

    road, other, hidden = (np.array(colour, np.uint8) for colour in COLOURS)
    known = np.isfinite(plan.road)[..., None]
    cells = np.where(known, np.where((plan.road > ROAD)[..., None], road, other), hidden)
    size = (SCALE * cells.shape[1], SCALE * cells.shape[0])
    canvas = cv2.resize(cells[::-1].copy(), size, interpolation=cv2.INTER_NEAREST)

    def place(points: NDArray[np.float64]) -> NDArray[np.int32]:
        x = (points[:, 0] + plan.left_m[0]) * SCALE / CELL_M
        y = (points[:, 1] + plan.ahead_m[-1]) * SCALE / CELL_M
        return np.round(np.stack([x, y], axis=1)).astype(np.int32)

    axis = place(np.array([[0.0, -plan.ahead_m[0]], [0.0, -plan.ahead_m[-1]]]))
    cv2.polylines(canvas, [axis], isClosed=False, color=LINE, thickness=1)
    for ahead_m in range(0, int(plan.ahead_m[-1]), 10):
        tick = place(np.array([[-1.0, -ahead_m], [1.0, -ahead_m]], np.float64))
        cv2.polylines(canvas, [tick], isClosed=False, color=LINE, thickness=1)
    for line, _ in () if seen is None else opening_lines(seen):
        cv2.polylines(canvas, [place(line)], isClosed=False, color=OPENING, thickness=2)
    return np.asarray(canvas, np.uint8)


def plans_of(run: RunFolder, wanted: Iterable[int]) -> Mapping[int, Bytes]:
    """Draw the plan views of a run at some times; none if it has no accumulated road."""
    manifest, times = run.drive_manifest(), frozenset(wanted)
    vehicle, detected = manifest.settings, manifest.detected
    has_odometry = run.file("measurements.parquet").exists()
    if vehicle.regions.kind != "area" or detected is None or not has_odometry:
        return {}
    roads, ego = Roads(vehicle, pitches_of(run)), EgoMotion(odometer_of(run))
    restarts, found = Restarts(vehicle, detected.timeline), {}
    for frame in stored_frames(run, detected, vehicle, with_road_masks=True):
        fresh_ns = restarts.before(frame.t_ns)
        if fresh_ns is not None:
            ego.restart(fresh_ns)
            roads.restart()
        evidence, _ = ego(frame.t_ns)
        roads(frame, evidence)
        plan = roads.plan() if frame.t_ns in times else None
        if plan is not None:
            found[frame.t_ns] = draw_plan(plan, roads.seen)
    return found
