"""A run seen in a mirror: left and right exchanged in everything that the scene stage reads."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np
import pytest

from crosscue.detectors import rle
from crosscue.detectors.base import Detections, RoadMask
from crosscue.detectors.cues.far_side import MobileyeState
from crosscue.detectors.cues.observed import FrameDetections, RoadFractions
from crosscue.eval.pipeline.replay import observe
from crosscue.eval.pipeline.scene import stage
from crosscue.eval.pipeline.scene.stage import SceneTables, features_of, gives_reasons
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.manifest import DetectManifest
from crosscue.eval.runs.tables.mobileye_tables import StoredMobileye
from crosscue.eval.runs.tables.stored_frames import stored_frames
from crosscue.eval.runs.tables.travelled import Odometer, Way
from crosscue.replay.signals.kinds import LANE_COLUMNS, OBSTACLE_COLUMNS
from crosscue.replay.vehicle.vehicle import Vehicle

OTHER: Final = {"left": "right", "right": "left"}


def exchanged(name: str) -> str:
    """Return a name with left and right exchanged."""
    return re.sub("left|right", lambda side: OTHER[side[0]], name)


def vehicle_of(vehicle: Vehicle, size_px: tuple[int, int]) -> Vehicle:
    """Return the vehicle file of the mirrored car."""
    camera, regions = vehicle.camera, vehicle.regions
    center_px = camera.center_px
    if center_px is not None:
        center_px = (size_px[0] - center_px[0], center_px[1])
    turned = {
        "center_px": center_px,
        "y_m": -camera.y_m,
        "yaw_rad": -camera.yaw_rad,
        "roll_rad": -camera.roll_rad,
    }
    polygons = {
        exchanged(side): tuple((1.0 - x, y) for x, y in getattr(regions, side))
        for side in ("left", "straight", "right")
    }
    return vehicle.model_copy(
        update={
            "camera": camera.model_copy(update=turned),
            "regions": regions.model_copy(update=polygons),
        }
    )


def mask_of(mask: bytes, size_px: tuple[int, int]) -> bytes:
    if not mask:
        return mask
    return rle.encode_mask(rle.decode_mask(mask, size_px)[:, ::-1], (0, 0), size_px)


def detections_of(found: Detections) -> Detections:
    boxes_px = found.boxes_px.copy()
    boxes_px[:, [0, 2]] = found.size_px[0] - boxes_px[:, [2, 0]]
    return replace(
        found,
        boxes_px=boxes_px,
        labels=tuple(map(exchanged, found.labels)),
        masks=tuple(mask_of(one, found.size_px) for one in found.masks),
    )


def frame_of(frame: FrameDetections) -> FrameDetections:
    road = frame.road
    if isinstance(road, RoadMask):
        road = replace(road, mask=mask_of(road.mask, road.mask_size_px))
    elif road is not None:
        road = RoadFractions(road.right, road.straight, road.left)
    return replace(
        frame,
        objects=tuple(map(detections_of, frame.objects)),
        signs=tuple(map(detections_of, frame.signs)),
        doubles=tuple(map(detections_of, frame.doubles)),
        road=road,
    )


def state_of(state: MobileyeState) -> MobileyeState:
    obstacles, lanes = state.obstacles, state.lanes
    if obstacles is not None:
        obstacles = obstacles.copy()
        obstacles[:, OBSTACLE_COLUMNS.index("y_m")] *= -1.0
    if lanes is not None:
        lanes = lanes.copy()
        for name in ("side", "c0_m", "c1", "c2_per_m", "c3_per_m2"):
            lanes[:, LANE_COLUMNS.index(name)] *= -1.0
    return MobileyeState(obstacles, lanes)


class Mirror:
    """Patches the scene stage so that it sees every run in a mirror."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        until, at = Odometer.until, StoredMobileye.at

        def mirrored_frames(*args: Any, **named: Any) -> Iterator[FrameDetections]:
            return map(frame_of, stored_frames(*args, **named))

        def mirrored_until(self: Odometer, t_ns: int) -> Way:
            way = until(self, t_ns)
            return way._replace(turn_rad=-way.turn_rad)

        def mirrored_at(self: StoredMobileye, t_ns: int) -> MobileyeState:
            return state_of(at(self, t_ns))

        patch.setattr(stage, "stored_frames", mirrored_frames)
        patch.setattr(Odometer, "until", mirrored_until)
        patch.setattr(StoredMobileye, "at", mirrored_at)


Rows = dict[str, list[dict[str, Any]]]


def observed(drive: Drive, run: RunFolder, detected: DetectManifest) -> Rows:
    """Return the rows of the scene's tables."""
    found: Rows = {}

    def sink(name: str, columns: dict[str, list[Any]]) -> None:
        found.setdefault(name, []).extend(
            dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)
        )

    vehicle = drive.vehicle
    tables = SceneTables(sink, features_of(vehicle), gives_reasons(vehicle))
    observe(drive, run, detected, tables)
    tables.flush()
    return found


def rows_of(found: Rows, width_px: int) -> Rows:
    """Return the rows that the mirrored run has to have."""
    mirrored: Rows = {}
    for name, rows in found.items():
        mirrored[name] = [
            {
                exchanged(column): exchanged(value) if isinstance(value, str) else value
                for column, value in row.items()
            }
            for row in rows
        ]
        for row in mirrored[name]:
            if name == "ranged_objects":
                row["x0"], row["x1"] = width_px - row["x1"], width_px - row["x0"]
    return mirrored


def differences(one: Rows, other: Rows) -> list[str]:
    """Return what differs by more than rounding, apart from the order of rows of one frame."""
    found = []
    for name in sorted(one.keys() | other.keys()):
        mine, theirs = (sorted(rows.get(name, []), key=_key) for rows in (one, other))
        if len(mine) != len(theirs):
            found.append(f"{name}: {len(mine)} and {len(theirs)} rows")
        for a, b in zip(mine, theirs, strict=False):
            for column in a:
                if not _is_same(a[column], b[column]):
                    where = f"{name} at {a['t_ns']} {a.get('cue', '')} {column}"
                    found.append(f"{where}: {a[column]} and {b[column]}")
    return found


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["t_ns"], row.get("cue", ""), row.get("reference") or "", row.get("object", 0)


def _is_same(one: Any, other: Any) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return bool(np.isclose(one, other, rtol=1e-6, atol=1e-6, equal_nan=True))
    if isinstance(one, str) and isinstance(other, str):
        # Reasons are in the order of the table of cues.
        return sorted(one.split("; ")) == sorted(other.split("; "))
    return bool(one == other)
