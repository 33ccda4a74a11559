"""Ranges of single vehicles by ground and size against PandaSet's boxes, by distance.

    python benchmarks/vehicle_ranges.py RUN SEQUENCE [CAMERA_HEIGHT_M ...]

RUN is a run of ``replay`` over SEQUENCE (as published, with annotations/cuboids.parquet). A
detection belongs to the projected box that it overlaps most, at IoU 0.6 or more; its true range is
that of the nearest corner of the box along the camera's axis.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from crosscue.detectors.boxes import box_ious
from crosscue.detectors.ranging.detection_range import (
    GroundCamera,
    OneRange,
    ground_range,
    size_range,
    vehicle_range,
)
from crosscue.detectors.ranging.standard_sizes import VEHICLES
from crosscue.eval.runs.folder import open_run
from crosscue.replay.columns import Floats

MIN_SCORE = 0.5
MIN_IOU = 0.6
EDGES_M = (0.0, 15.0, 30.0, 50.0, 80.0, 150.0)
VEHICLE_WORDS = ("Car", "Truck", "Bus", "Vehicle", "Van")


def _projected(folder: Path, focal_px: float, center_px: tuple[float, float]) -> dict[int, Floats]:
    """Return rows of x0, y0, x1, y1 and nearest depth for each frame."""
    poses = json.loads((folder / "camera/front_camera/poses.json").read_text())
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.5
    found: dict[int, list[list[float]]] = {}
    for row in pq.read_table(folder / "annotations/cuboids.parquet").to_pylist():
        if not any(word in row["label"] for word in VEHICLE_WORDS):
            continue
        pose = poses[row["frame"]]
        camera = Rotation.from_quat([pose["heading"][k] for k in "xyzw"])
        corners = signs * [row["width_m"], row["length_m"], row["height_m"]]
        corners = Rotation.from_euler("z", row["yaw_rad"]).apply(corners)
        corners += [row["x_m"], row["y_m"], row["z_m"]]
        seen = camera.inv().apply(corners - [pose["position"][k] for k in "xyz"])
        if (seen[:, 2] < 2.0).any():
            continue
        at = focal_px * seen[:, :2] / seen[:, 2:] + center_px
        box = [*at.min(axis=0), *at.max(axis=0), float(seen[:, 2].min())]
        found.setdefault(row["frame"], []).append(box)
    return {frame: np.array(rows) for frame, rows in found.items()}


def _pairs(run: Path, folder: Path) -> Iterator[tuple[dict[str, Any], float]]:
    """Yield detections that are not cut by the image border, with their true range."""
    opened = open_run(run)
    camera = opened.drive_manifest().settings.camera
    boxes = _projected(folder, camera.focal_px or 0.0, camera.center_px or (0.0, 0.0))
    for row in opened.table("detections").to_pylist():
        width, height = row["picture_width_px"], row["picture_height_px"]
        is_cut = min(row["x0"], row["y0"]) < 2 or row["x1"] > width - 2 or row["y1"] > height - 2
        if row["label"] not in VEHICLES or row["score"] <= MIN_SCORE or is_cut:
            continue
        near = boxes.get(row["frame"], np.empty((0, 5)))
        box = np.array([row[name] for name in ("x0", "y0", "x1", "y1")])
        shared = box_ious(box, near[:, :4]) if len(near) else np.zeros(1)
        if shared.max() > MIN_IOU:
            yield row, float(near[int(np.argmax(shared)), 4])


def _report_text(found: list[tuple[OneRange, float]]) -> str:
    if not found:
        return "none"
    off = np.array([one.mean_m / true_m - 1.0 for one, true_m in found])
    inside = [abs(one.mean_m - true_m) < 1.96 * one.sd_m for one, true_m in found]
    typical = f"{np.median(off):+5.0%}, typically {np.median(np.abs(off)):4.0%}"
    return f"{len(found):3} {typical}, {np.mean(inside):4.0%} inside"


def main() -> None:
    """Print errors by distance and method."""
    run, folder = Path(sys.argv[1]), Path(sys.argv[2])
    settings = open_run(run).drive_manifest().settings.camera
    pairs = list(_pairs(run, folder))
    for height_m in [float(text) for text in sys.argv[3:]] or [settings.z_m]:
        focal_px, center_y_px = settings.focal_px or 0.0, (settings.center_px or (0, 0))[1]
        camera = GroundCamera(focal_px, height_m)
        print(f"camera {height_m} m above the ground")
        for near_m, far_m in pairwise(EDGES_M):
            inside = [(row, true_m) for row, true_m in pairs if near_m <= true_m < far_m]
            by: dict[str, list[tuple[OneRange, float]]] = {"ground": [], "size": [], "both": []}
            for row, true_m in inside:
                height_px, size = row["height_px"], VEHICLES[row["label"]]
                slope = (row["y1"] - center_y_px) / focal_px
                ground = ground_range(slope, height_px, camera)
                by["ground"] += [] if ground is None else [(ground, true_m)]
                by["size"].append((size_range(height_px, camera.focal_px, size), true_m))
                by["both"].append((vehicle_range(slope, height_px, camera, size), true_m))
            texts = "  ".join(f"{name}: {_report_text(some)}" for name, some in by.items())
            print(f"  {near_m:3.0f} to {far_m:3.0f} m  {texts}")


if __name__ == "__main__":
    main()
