"""Annotate PandaSet's sequence 002: our truth of an approach, from its boxes, its poses and by eye.

    python -m crosscue.datasets.real.annotate_pandaset SEQUENCE [FOLDER]

writes ``truth.json`` and ``ranges.csv`` beside this file, or into FOLDER. SEQUENCE is the folder of
the sequence with its 3-D boxes in ``annotations/cuboids.parquet``, one row for each box in each
frame (the set publishes them as pickles, which are not read here).

From the boxes: moving cars across the ego road, cars parked across it, vehicles past the far kerb.
By eye, on frames 0, 20, 40, 60 and 79: the four signals that face the ego vehicle, the roads, and
that no stop sign stands there. The crosswalk and the far kerb were measured in the frames on the
ground plane under the boxes; each is known to 2.5 m. Left open, since nothing here can say: lane
lines past the intersection, one-way and do-not-enter signs.
"""

from __future__ import annotations

import csv
import io
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from crosscue.datasets.adapters.pandaset import FRONT, Poses, read_poses
from crosscue.datasets.truth.truth import Approach, CueTruth, Features, Truth, save
from crosscue.replay.base import Floats, json_tree, write_text
from crosscue.replay.vehicle.vehicle import load

FOLDER: Final = Path(__file__).parent / "pandaset_002"
RANGES: Final = "ranges.csv"
CROSSWALK_M: Final = 59.0
"""Along the road from the camera in the first frame to the near edge of the crosswalk."""
FAR_KERB_M: Final = 79.0
SIGNALS: Final = 4
"""Two with a green light, two with a red arrow; three more are seen from behind or the side."""
VEHICLES: Final = ("Car", "Pickup Truck", "Medium-sized Truck", "Bus")
WIDTH_PX: Final = 1920
REACH_M: Final = 110.0
"""Of a vehicle further away nobody can tell its direction in these frames apart from others."""
ACROSS_DEG: Final = 45.0
"""A vehicle whose heading is further off the road, both ways, stands or moves across it."""


class Boxes:
    """Vehicles ahead inside the picture, as the front camera has them."""

    def __init__(self, sequence: Path, poses: Poses) -> None:
        """Read the boxes of a sequence."""
        import pyarrow.parquet as pq

        table = pq.read_table(sequence / "annotations" / "cuboids.parquet")
        columns: dict[str, Any] = {
            name: table[name].to_numpy() for name in ("frame", "x_m", "y_m", "yaw_rad")
        }
        frame = columns["frame"]
        at = np.column_stack([columns["x_m"], columns["y_m"]]) - poses.xyz_m[frame, :2]
        forward, left = poses.forward[frame, :2], poses.left[frame, :2]
        ahead, aside = (at * forward).sum(axis=1), (at * left).sum(axis=1)
        # A box is long along its own y axis.
        along = np.column_stack([-np.sin(columns["yaw_rad"]), np.cos(columns["yaw_rad"])])
        turn = np.arctan2((along * left).sum(axis=1), (along * forward).sum(axis=1))
        focal, center = _intrinsics(sequence)
        column_px = center - focal * aside / np.maximum(ahead, 1e-9)
        kept = np.isin(table["label"].to_pylist(), VEHICLES) & (ahead > 0.0) & (ahead < REACH_M)
        kept &= (column_px >= 0.0) & (column_px < WIDTH_PX)
        self.frame: Final = frame[kept]
        self.ahead_m: Final[Floats] = ahead[kept]
        self.turn_deg: Final[Floats] = np.degrees(turn[kept])
        self.motion: Final = np.array(table["motion"].to_pylist())[kept]

    def across(self, motion: str, *, to_left: bool) -> NDArray[np.bool_]:
        """Vehicles across the road that move so, by where they head."""
        turn = self.turn_deg if to_left else -self.turn_deg
        is_across = (turn > ACROSS_DEG) & (turn < 180.0 - ACROSS_DEG)
        return np.asarray(is_across & (self.motion == motion))


def annotate(sequence: Path, folder: Path = FOLDER) -> Path:
    """Write the truth of the sequence.

    Raises:
        LogFormatError: The sequence has no poses.
        OutputError: It cannot be written.
    """
    poses = read_poses(sequence)
    boxes = Boxes(sequence, poses)
    start_ns, end_ns = int(poses.t_ns[0]), int(poses.t_ns[-1]) + 1
    gone_m = _travelled_m(poses)
    # Of each vehicle from the camera in the first frame, as the crosswalk and the kerb are.
    past = boxes.ahead_m + gone_m[boxes.frame] > FAR_KERB_M
    seen = {
        "cross_traffic_left": boxes.across("Moving", to_left=True),
        "cross_traffic_right": boxes.across("Moving", to_left=False),
        "parked_left": boxes.across("Parked", to_left=True),
        "parked_right": boxes.across("Parked", to_left=False),
        "vehicles_past": past,
    }
    cues = [
        span
        for name, rows in seen.items()
        for span in _spans(name, poses, np.bincount(boxes.frame[rows], minlength=len(poses.t_ns)))
    ]
    everywhere = {"traffic_light": SIGNALS, "stop_sign": 0} | dict.fromkeys(
        ("road_left", "road_straight", "road_right"), 1
    )
    for name, count in everywhere.items():
        cues.append(
            CueTruth(
                cue=name,
                present=count > 0,
                start_ns=start_ns,
                end_ns=end_ns,
                approach=1,
                count=count,
            )
        )
    truth = Truth(
        version=1,
        log="pandaset_002",
        start_ns=start_ns,
        end_ns=end_ns,
        source=_SOURCE,
        approaches=(
            Approach(
                id=1,
                intersection="PandaSet 002",
                start_ns=start_ns,
                enter_ns=end_ns,
                control="traffic_light",
                features=Features(left=True, right=True, straight=True),
                conditions=("queue",),
                length_m=FAR_KERB_M - CROSSWALK_M,
            ),
        ),
        cues=tuple(sorted(cues, key=lambda one: (one.start_ns or 0, one.cue))),
        ranges=RANGES,
    )
    folder.mkdir(parents=True, exist_ok=True)
    camera_x_m = load(FOLDER / "vehicle.toml").camera.x_m
    write_text(folder / RANGES, _ranges(poses, gone_m, camera_x_m))
    return save(truth, folder)


_SOURCE: Final = (
    "annotated for crosscue from PandaSet's boxes and poses (Scale AI, Hesai; CC BY 4.0) and by "
    "eye; crosswalk 59 m and far kerb 79 m from the camera in the first frame, each to 2.5 m; the "
    "log ends before the vehicle enters; a car waiting in the left leg is neither parked nor "
    "crossing; vehicles_past counts boxes, hidden ones included"
)


def _spans(cue: str, poses: Poses, counts: NDArray[np.int64]) -> list[CueTruth]:
    """Runs of frames with the same answer, as spans that touch."""
    present = counts > 0
    starts = [0, *(np.flatnonzero(np.diff(present)) + 1).tolist()]
    times = [*poses.t_ns[starts].tolist(), int(poses.t_ns[-1]) + 1]
    return [
        CueTruth(
            cue=cue,
            present=bool(present[first]),
            start_ns=times[i],
            end_ns=times[i + 1],
            approach=1,
            count=None if present[first] else 0,
        )
        for i, first in enumerate(starts)
    ]


def _travelled_m(poses: Poses) -> Floats:
    steps = np.linalg.norm(np.diff(poses.xyz_m[:, :2], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _ranges(poses: Poses, gone_m: Floats, camera_x_m: float) -> str:
    """Ranges of the rear axle at every picture, as a table."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("t_ns", "approach", "start_m", "end_m"))
    for t_ns, gone in zip(poses.t_ns.tolist(), gone_m.tolist(), strict=True):
        start, end = (there + camera_x_m - gone for there in (CROSSWALK_M, FAR_KERB_M))
        rows.writerow((t_ns, 1, f"{start:.2f}", f"{end:.2f}"))
    return text.getvalue()


def _intrinsics(sequence: Path) -> tuple[float, float]:
    """Focal length and the column of the optical axis."""
    found = json_tree((sequence / "camera" / FRONT / "intrinsics.json").read_bytes())
    return float(found["fx"]), float(found["cx"])


if __name__ == "__main__":
    print(annotate(*map(Path, sys.argv[1:3])))
