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
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.datasets.adapters.pandaset import read_pandaset_poses
from crosscue.datasets.truth.coco import CocoRows
from crosscue.replay.columns import Floats
from crosscue.replay.errors import LogFormatError

from .annotate_pandaset import corners_m, intrinsics_of, read_boxes

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


def write_labels(sequence: Path, output: Path) -> Path:
    """Write the labels.

    Raises:
        LogFormatError: The sequence has no poses, or no table of boxes.
        OutputError: It cannot be written.
    """
    poses, boxes = read_pandaset_poses(sequence), read_boxes(sequence)
    fx, fy, cx, cy = intrinsics_of(sequence)
    ahead, aside, up = np.moveaxis(corners_m(boxes, poses), 2, 0)
    range_m = ahead.mean(axis=1)
    corners_px = np.stack([cx - fx * aside / ahead, cy - fy * up / ahead], axis=2)
    low = np.clip(corners_px.min(axis=1), 0.0, SIZE_PX)
    high = np.clip(corners_px.max(axis=1), 0.0, SIZE_PX)
    is_seen = (ahead.min(axis=1) >= NEAR_M) & (high - low >= 1.0).all(axis=1)
    labels = CocoRows()
    for frame, t_ns in enumerate(poses.t_ns.tolist()):
        labels.add_image(f"{frame:02}.jpg", SIZE_PX, id=frame, t_ns=t_ns)
        rows = np.flatnonzero((boxes["frame"] == frame) & is_seen)
        rows = rows[np.argsort(range_m[rows], kind="stable")]
        for row, visible in zip(rows.tolist(), _visible(corners_px[rows]), strict=True):
            name = LABELS.get(str(boxes["label"][row]))
            (x0, y0), (x1, y1) = low[row].tolist(), high[row].tolist()
            is_out = name is None or visible < MIN_VISIBLE or range_m[row] > REACH_M
            labels.add_box(
                CATEGORIES[name or "truck"],
                (x0, y0, x1, y1),
                bbox=[round(v, 1) for v in (x0, y0, x1 - x0, y1 - y0)],
                area=round((x1 - x0) * (y1 - y0), 1),
                iscrowd=int(is_out),
                visible=round(visible, 3),
                range_m=round(float(range_m[row]), 2),
            )
    source = "PandaSet 002 (Scale AI, Hesai; CC BY 4.0): projected boxes"
    return labels.write(output, source, CATEGORIES)


def _visible(corners_px: Floats) -> Iterator[float]:
    """Yield the fraction of each box in the picture that no earlier, nearer box hides."""
    import cv2

    hidden = np.zeros(SIZE_PX[::-1], np.uint8)
    for corners in corners_px:
        mine = np.zeros_like(hidden)
        hull = cv2.convexHull(np.clip(corners, -20_000, 20_000).astype(np.int32))
        whole = float(cv2.contourArea(hull))
        cv2.fillConvexPoly(mine, hull, (1,))
        shown = int((mine & ~hidden & 1).sum())
        hidden |= mine
        yield min(shown / max(whole, 1.0), 1.0)


if __name__ == "__main__":
    try:
        print(write_labels(Path(sys.argv[1]), Path(sys.argv[2])))
    except LogFormatError as error:
        sys.exit(f"crosscue: {error}")
