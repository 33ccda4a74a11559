"""Simulate a Mobileye in a world: vehicles ahead and lane lines, with faults.

Range, field of view, miss rates and errors are plausible values that were not measured. Only the
position error of a few per cent comes from the public description of the protocol.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.random import Generator

from crosscue.datasets.scenes.rendering.render import RenderedFrame, RenderedObject
from crosscue.replay.columns import Block, Int64s, Table
from crosscue.replay.mobileye.can.encode import bursts_of, encode_tables
from crosscue.replay.mobileye.geometry import DevicePosition
from crosscue.replay.mobileye.settings import MobileyeSettings
from crosscue.replay.mobileye.tables import table_block

from .layout import Layout
from .motion import FRONT_M, lane_y_m
from .world import World

MOUNTING: Final = DevicePosition(x_m=FRONT_M)
SETTINGS: Final = MobileyeSettings(revision="classic", mounting=MOUNTING)
SOLID, ROAD_EDGE, DOUBLE = 1, 3, 4
STANDING, MOVING, ONCOMING, PARKED = 1, 3, 4, 5


# Half of the device's field of view, and bounds on the vehicles that it reports.
HALF_VIEW_RAD: Final = 0.33
_REACH_M, _MIN_VISIBLE = 95.0, 0.35
# Probability that a vehicle is reported: on the ego road, seen from the side, in a lot or driveway.
_HIT, _HIT_CROSSING, _HIT_OFF_ROAD = 0.9, 0.12, 0.18
# Errors of distance (relative) and of lateral position.
_PLACE_FRACTION, _SIDE_M = 0.03, 0.15


class Device:
    """A Mobileye during one drive, with the state of its tracks."""

    def __init__(self, world: World, rng: Generator) -> None:
        """Begin without tracks."""
        self._world = world
        self._rng = rng
        self._reports: dict[int, bool] = {}
        self._scale: dict[int, float] = {}
        self._age: dict[int, int] = {}
        self._sees_past = False

    def frames(self, times_ns: Int64s, pictures: Sequence[RenderedFrame], bus: str) -> Block:
        """Return CAN frames for pictures grabbed at ``times_ns``."""
        rows = [
            row
            for t_ns, picture in zip(times_ns.tolist(), pictures, strict=True)
            for row in self._obstacles(t_ns, picture)
        ]
        columns = {
            name: np.array([row[name] for row in rows], kind) for name, kind in _COLUMNS.items()
        }
        latency = 80_000_000 + np.rint(self._rng.exponential(1.5e6, len(times_ns))).astype(np.int64)
        tables = bursts_of(times_ns, Table(columns), SETTINGS, latency_ns=latency, bus=bus)
        tables.append(self._lanes(times_ns, pictures, latency, bus))
        return encode_tables(tables, SETTINGS, bus)

    def _obstacles(self, t_ns: int, picture: RenderedFrame) -> list[dict[str, float]]:
        x, y, heading = picture.view.rear_axle
        c, s = np.cos(heading), np.sin(heading)
        rows = []
        for seen in picture.seen:
            if seen.thing.category != "car":
                continue
            middle = np.array(seen.thing.at) + seen.thing.shift(picture.t_s)
            dx, dy = middle[0] - x, middle[1] - y
            ahead, left = c * dx + s * dy, -s * dx + c * dy
            if not self._is_reported(seen, ahead, left):
                self._age.pop(seen.thing.number, None)
                continue
            rows.append(self._row(t_ns, seen, picture, ahead, left))
        return rows

    def _is_reported(self, seen: RenderedObject, ahead: float, left: float) -> bool:
        number = seen.thing.number
        front = ahead - FRONT_M
        if front < 1.0 or front > _REACH_M or seen.visible < _MIN_VISIBLE:
            return False
        if abs(np.arctan2(left, front)) > HALF_VIEW_RAD:
            return False
        chance = _HIT
        if seen.thing.role in ("cross", "parked_cross"):
            chance = _HIT_CROSSING
        elif abs(seen.thing.at[1]) > self._world.layout.half_width_m:
            chance = _HIT_OFF_ROAD
        chance *= 1.0 - 0.15 * self._world.conditions.rain
        # A state is drawn about once a second, so that hits and misses occur in runs.
        if number not in self._reports or self._rng.random() < 0.1:
            self._reports[number] = bool(self._rng.random() < chance)
        return self._reports[number]

    def _row(
        self, t_ns: int, seen: RenderedObject, picture: RenderedFrame, ahead: float, left: float
    ) -> dict[str, float]:
        thing, number = seen.thing, seen.thing.number
        if number not in self._scale:
            self._scale[number] = float(self._rng.normal(1.0, _PLACE_FRACTION))
        self._age[number] = min(self._age.get(number, 0) + 1, 254)
        heading = picture.view.rear_axle[2]
        vx = thing.velocity[0] * np.cos(heading) + thing.velocity[1] * np.sin(heading)
        status = {"oncoming": ONCOMING, "outgoing": MOVING, "cross": MOVING}.get(
            thing.role, PARKED if thing.role == "parked_past" else STANDING
        )
        near = (ahead - thing.size[0] / 2 - FRONT_M) * self._scale[number] + FRONT_M
        return {
            "t_ns": t_ns,
            "obstacle_id": number % 200 + 1,
            "x_m": max(near + self._rng.normal(0, 0.1), FRONT_M),
            "y_m": left + self._rng.normal(0, _SIDE_M),
            "vx_mps": vx - picture.view.speed_mps + self._rng.normal(0, 0.2),
            "type": 1 if thing.size[0] > 5.3 else 0,
            "status": status,
            "length_m": thing.size[0],
            "width_m": thing.size[1] * (1 + self._rng.normal(0, 0.05)),
            "age_frames": self._age[number],
            "valid": 1 if self._age[number] == 1 else 2,
        }

    def _lanes(
        self, times_ns: Int64s, pictures: Sequence[RenderedFrame], latency: Int64s, bus: str
    ) -> Block:
        layout, rng = self._world.layout, self._rng
        lines = lane_lines_m(layout)
        # Without a parking lane there is no painted line at the side, only the kerb.
        outer_type = SOLID if layout.has_parking_lane else ROAD_EDGE
        rows: dict[str, list[float]] = {name: [] for name in _LANE_COLUMNS}
        for picture in pictures:
            x, y, heading = picture.view.rear_axle
            is_turning = abs(heading) > 0.25 or x > -1.0
            reach, quality = self._lane_reach(x), 3 if self._world.conditions.rain < 0.4 else 2
            for side, line_y in zip((1, -1), lines, strict=True):
                lost = is_turning or rng.random() < 0.03
                rows["side"].append(side)
                rows["lane_type"].append(
                    2 if lost else outer_type if side == layout.own else DOUBLE
                )
                rows["quality"].append(0 if lost else quality)
                rows["model_degree"].append(2)
                rows["c0_m"].append(np.nan if lost else line_y - y + rng.normal(0, 0.03))
                rows["c1"].append(np.nan if lost else -np.tan(heading) + rng.normal(0, 0.002))
                rows["c2_per_m"].append(np.nan if lost else rng.normal(0, 2e-5))
                rows["c3_per_m2"].append(np.nan if lost else 0.0)
                rows["marking_width_m"].append(0.12)
                rows["view_range_m"].append(0.0 if lost else max(reach - FRONT_M, 0.0))
                rows["view_range_available"].append(0 if lost else 1)
        columns = {name: np.array(rows[name], kind) for name, kind in _LANE_COLUMNS.items()}
        sent = np.repeat(times_ns + latency + 14_000_000, 2)
        return table_block(bus, "lanes", sent, columns)

    def _lane_reach(self, x: float) -> float:
        """Return the end of the lines from the rear axle, at the stop line or past it."""
        layout, conditions = self._world.layout, self._world.conditions
        to_start, to_end = -x, layout.end_m - x
        sight = 58.0 * (1 - 0.35 * conditions.rain) * (0.8 if conditions.light == "dusk" else 1.0)
        chance = 0.75 if layout.has_ahead and to_end < sight - 8.0 else 0.01
        if self._rng.random() < 0.08:
            self._sees_past = bool(self._rng.random() < chance)
        is_endless = layout.has_ahead and not layout.is_intersection
        if (self._sees_past and layout.has_ahead) or is_endless:
            return float(sight + self._rng.normal(0, 1.0))
        return float(min(to_start, sight) + self._rng.normal(0, 0.4))


def lane_lines_m(layout: Layout) -> tuple[float, float]:
    """Return the lateral positions of the painted lines left and right of the ego lane."""
    inner_m, outer_m = -0.17 * layout.own, 2 * lane_y_m(layout)
    return (outer_m, inner_m) if layout.traffic == "left" else (inner_m, outer_m)


_COLUMNS: Final = {
    "t_ns": np.int64, "obstacle_id": np.int16, "x_m": np.float64, "y_m": np.float64,
    "vx_mps": np.float64, "type": np.int16, "status": np.int16, "length_m": np.float64,
    "width_m": np.float64, "age_frames": np.int16, "valid": np.int16,
}  # fmt: skip
_LANE_COLUMNS: Final = {
    "side": np.int8, "lane_type": np.int16, "quality": np.int16, "model_degree": np.int16,
    "c0_m": np.float64, "c1": np.float64, "c2_per_m": np.float64, "c3_per_m2": np.float64,
    "marking_width_m": np.float64, "view_range_m": np.float64, "view_range_available": np.int16,
}  # fmt: skip
