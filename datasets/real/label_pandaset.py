"""Label PandaSet's sequence 002: boxes of its pictures as COCO, from its 3-D boxes.

    python -m crosscue.datasets.real.label_pandaset SEQUENCE OUT.json

SEQUENCE is the folder of the sequence with its 3-D boxes in ``annotations/cuboids.parquet``, as for
``annotate_pandaset``. Each box is projected into the front camera and drawn from far to near, which
yields the fraction that nearer boxes hide. An object that is more than half hidden, further than
60 m, or neither car nor truck nor person, is a region that is not scored (``iscrowd``). Boxes have
stamps about 50 ms after the picture, and a projected box is slightly wider than its object. Scores
should therefore use an overlap of at most 0.5.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from crosscue.datasets.adapters.pandaset import FRONT, PandasetPoses, read_pandaset_poses
from crosscue.datasets.truth.coco import CocoRows
from crosscue.replay.columns import Floats
from crosscue.replay.errors import LogFormatError
from crosscue.replay.files.tree_text import json_tree

CATEGORIES: Final = {"car": 1, "truck": 2, "person": 3}
LABELS: Final = {
    "Car": "car",
    "Pickup Truck": "truck",
    "Medium-sized Truck": "truck",
    "Pedestrian": "person",
    "Pedestrian with Object": "person",
}
SIZE_PX: Final = (1920, 1080)
REACH_M: Final = 60.0
MIN_VISIBLE: Final = 0.5
# Boxes nearer to the camera's plane are not projected.
NEAR_M: Final = 1.0
_COLUMNS: Final = ("frame", "label", "x_m", "y_m", "z_m", "width_m", "length_m", "height_m")
_CORNERS: Final = np.array(
    [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """One 3-D box in one picture: label, range, and corners of shape (8, 2) in pixels."""

    label: str
    range_m: float
    corners_px: Floats


def write_labels(sequence: Path, output: Path) -> Path:
    """Write the labels.

    Raises:
        LogFormatError: The sequence has no poses, or no table of boxes.
        OutputError: It cannot be written.
    """
    import pyarrow.parquet as pq

    poses = read_pandaset_poses(sequence)
    found = json_tree((sequence / "camera" / FRONT / "intrinsics.json").read_bytes())
    camera = np.array([found[name] for name in ("fx", "fy", "cx", "cy")], np.float64)
    path = sequence / "annotations" / "cuboids.parquet"
    if not path.exists():
        raise LogFormatError(
            f"{path}: missing; the boxes are published as pickles, which are not read; "
            "docs/reference/formats.md describes how to convert them to this table"
        )
    table = pq.read_table(path)
    rows: dict[str, Any] = {
        name: table[name].to_numpy(zero_copy_only=False) for name in (*_COLUMNS, "yaw_rad")
    }
    labels = CocoRows()
    for frame, t_ns in enumerate(poses.t_ns.tolist()):
        labels.add_image(f"{frame:02}.jpg", SIZE_PX, id=frame, t_ns=t_ns)
        seen = [
            one
            for row in np.flatnonzero(rows["frame"] == frame)
            if (one := _projected(rows, int(row), poses, frame, camera)) is not None
        ]
        for one, visible in _visible(seen):
            name = LABELS.get(one.label)
            low = np.clip(one.corners_px.min(axis=0), 0.0, SIZE_PX)
            high = np.clip(one.corners_px.max(axis=0), 0.0, SIZE_PX)
            wide, high_px = (high - low).tolist()
            is_out = name is None or visible < MIN_VISIBLE or one.range_m > REACH_M
            labels.add_box(
                CATEGORIES[name or "truck"],
                (*low.tolist(), *high.tolist()),
                bbox=[round(v, 1) for v in (*low.tolist(), wide, high_px)],
                area=round(wide * high_px, 1),
                iscrowd=int(is_out),
                visible=round(visible, 3),
                range_m=round(one.range_m, 2),
            )
    source = "PandaSet 002 (Scale AI, Hesai; CC BY 4.0): projected boxes"
    return labels.write(output, source, CATEGORIES)


def _projected(
    rows: dict[str, Any], row: int, poses: PandasetPoses, frame: int, camera: Floats
) -> _Seen | None:
    """Return a box in the picture, or None if it is completely outside."""
    size = np.array([rows[f"{name}_m"][row] for name in ("width", "length", "height")])
    yaw = float(rows["yaw_rad"][row])
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
    center = np.array([rows[f"{axis}_m"][row] for axis in "xyz"])
    at = (_CORNERS * size) @ turn.T + center - poses.xyz_m[frame]
    forward, left = poses.forward[frame], poses.left[frame]
    ahead, aside, up = at @ forward, at @ left, at @ np.cross(forward, left)
    if ahead.min() < NEAR_M:
        return None
    fx, fy, cx, cy = camera.tolist()
    corners = np.column_stack([cx - fx * aside / ahead, cy - fy * up / ahead])
    low, high = np.clip(corners.min(axis=0), 0, SIZE_PX), np.clip(corners.max(axis=0), 0, SIZE_PX)
    if (high - low < 1.0).any():
        return None
    return _Seen(str(rows["label"][row]), float(ahead.mean()), corners)


def _visible(seen: list[_Seen]) -> Iterator[tuple[_Seen, float]]:
    """Yield each box with its fraction that is in the picture and not hidden by nearer boxes."""
    import cv2

    hidden = np.zeros(SIZE_PX[::-1], np.uint8)
    for one in sorted(seen, key=lambda box: box.range_m):
        mine = np.zeros_like(hidden)
        hull = cv2.convexHull(np.clip(one.corners_px, -20_000, 20_000).astype(np.int32))
        whole = float(cv2.contourArea(hull))
        cv2.fillConvexPoly(mine, hull, (1,))
        shown = int((mine & ~hidden & 1).sum())
        hidden |= mine
        yield one, min(shown / max(whole, 1.0), 1.0)


if __name__ == "__main__":
    try:
        print(write_labels(Path(sys.argv[1]), Path(sys.argv[2])))
    except LogFormatError as error:
        sys.exit(f"crosscue: {error}")
