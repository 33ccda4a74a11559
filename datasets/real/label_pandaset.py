"""Label PandaSet's sequence 002: boxes of its pictures as COCO, from its 3-D boxes.

    python -m crosscue.datasets.real.label_pandaset SEQUENCE OUT.json

SEQUENCE is the folder of the sequence with its 3-D boxes in ``annotations/cuboids.parquet``, one
row for each box in each frame (the data set publishes them as pickles, which are not read). Each
box is projected into the front camera and drawn from far to near, which yields the fraction that
nearer boxes hide. An object that is more than half hidden, further than 60 m, or neither car nor
truck nor person, is a region that is not scored (``iscrowd``). Boxes have stamps about 50 ms after
the picture, and a projected box is slightly wider than its object. Scores should therefore use an
overlap of at most 0.5.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from crosscue.datasets.adapters.pandaset import FRONT, PandasetPoses, read_pandaset_poses
from crosscue.datasets.adapters.published import json_of
from crosscue.datasets.truth.coco import CocoRows
from crosscue.replay.columns import Floats
from crosscue.replay.errors import LogFormatError

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
    hidden = np.zeros(SIZE_PX[::-1], np.uint8)
    for corners in corners_px:
        mine = np.zeros_like(hidden)
        hull = cv2.convexHull(np.clip(corners, -20_000, 20_000).astype(np.int32))
        whole = float(cv2.contourArea(hull))
        cv2.fillConvexPoly(mine, hull, (1,))
        shown = int((mine & ~hidden & 1).sum())
        hidden |= mine
        yield min(shown / max(whole, 1.0), 1.0)


def read_boxes(sequence: Path) -> dict[str, Any]:
    """Read the columns of a sequence's 3-D boxes.

    Raises:
        LogFormatError: There is no table of boxes.
    """
    import pyarrow.parquet as pq

    path = sequence / "annotations" / "cuboids.parquet"
    if not path.exists():
        raise LogFormatError(
            f"{path}: missing; the boxes are published as pickles, which are not read; "
            "docs/reference/formats.md describes how to convert them to this table"
        )
    table = pq.read_table(path)
    numbers = ("frame", "x_m", "y_m", "z_m", "yaw_rad", "width_m", "length_m", "height_m")
    texts = {name: np.array(table[name].to_pylist()) for name in ("label", "motion")}
    return {name: table[name].to_numpy() for name in numbers} | texts


def corners_m(boxes: dict[str, Any], poses: PandasetPoses) -> Floats:
    """Return the corners of N boxes ahead, left and up of the camera, shape (N, 8, 3)."""
    frame = boxes["frame"]
    forward, left = poses.forward[frame], poses.left[frame]
    axes = np.stack([forward, left, np.cross(forward, left)], axis=1)
    unit = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    own = unit * np.stack([boxes[f"{of}_m"] for of in ("width", "length", "height")], 1)[:, None]
    cos, sin = np.cos(boxes["yaw_rad"])[:, None], np.sin(boxes["yaw_rad"])[:, None]
    turned = [own[..., 0] * cos - own[..., 1] * sin, own[..., 0] * sin + own[..., 1] * cos]
    corners = np.stack([*turned, own[..., 2]], axis=2) + middles_m(boxes, poses)[:, None]
    return np.asarray(corners @ np.swapaxes(axes, 1, 2))


def middles_m(boxes: dict[str, Any], poses: PandasetPoses) -> Floats:
    """Return the centres of N boxes relative to their cameras, in the map's axes, shape (N, 3)."""
    middles = np.stack([boxes["x_m"], boxes["y_m"], boxes["z_m"]], 1)
    return np.asarray(middles - poses.xyz_m[boxes["frame"]])


def intrinsics_of(sequence: Path) -> tuple[float, float, float, float]:
    """Return both focal lengths, and column and row of the optical axis."""
    found = json_of(sequence / "camera" / FRONT / "intrinsics.json")
    return float(found["fx"]), float(found["fy"]), float(found["cx"]), float(found["cy"])


if __name__ == "__main__":
    try:
        print(write_labels(Path(sys.argv[1]), Path(sys.argv[2])))
    except LogFormatError as error:
        sys.exit(f"crosscue: {error}")
