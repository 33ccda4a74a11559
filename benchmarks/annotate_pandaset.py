"""Annotate PandaSet's sequence 002: truth of an approach from its boxes, its poses and by eye.

``python benchmarks/annotate_pandaset.py SEQUENCE [FOLDER]`` writes ``truth.json`` and
``ranges.csv`` to FOLDER, or to the package. SEQUENCE has its 3-D boxes as for ``label_pandaset``.

Annotated from the boxes: moving cars across the ego road, cars parked across it, vehicles past the
far kerb, and oncoming and outgoing vehicles among them. Visibility is the fraction of the most
visible vehicle that no other box hides, which is a lower bound because boxes are wider than cars.
Annotated by eye, on frames 0, 20, 40, 60 and 79: the four signals that face the ego vehicle, the
roads, and the absence of stop signs. The crosswalk and the far kerb were measured in the frames on
the ground plane under the boxes, each to 2.5 m. Not annotated: lane lines past the intersection,
one-way and do-not-enter signs.
"""

from __future__ import annotations

import csv
import io
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from crosscue.datasets.adapters.pandaset import PandasetPoses, read_pandaset_poses
from crosscue.datasets.real import recordings
from crosscue.datasets.real.label_pandaset import corners_m, intrinsics_of, middles_m, read_boxes
from crosscue.datasets.truth.truth import Approach, CueTruth, Features, Truth, save
from crosscue.replay.columns import Floats
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.vehicle.vehicle import load

FOLDER: Final = recordings.FOLDER / "pandaset_002"
RANGES: Final = "ranges.csv"
# Distance along the road from the camera in the first frame to the crosswalk's near edge.
CROSSWALK_M: Final = 59.0
FAR_KERB_M: Final = 79.0
# Number of signals: two with a green light, two with a red arrow. Three more are visible from
# behind or the side.
SIGNALS: Final = 4
VEHICLES: Final = ("Car", "Pickup Truck", "Medium-sized Truck", "Bus")
WIDTH_PX: Final = 1920
GRID: Final = 10
# Max distance of two boxes of one car; most cars have two boxes.
BEHIND_M: Final = 3.0
# Max distance at which the direction of a vehicle is recognizable in these frames.
REACH_M: Final = 110.0
ALONG: Final = ("oncoming_cars", "outgoing_cars")
# Min angle between road and heading of a vehicle across the road.
ACROSS_DEG: Final = 45.0


class VehicleBoxes:
    """Vehicles ahead that are inside the front camera's pictures."""

    def __init__(self, sequence: Path, poses: PandasetPoses) -> None:
        """Read the boxes of a sequence."""
        columns = read_boxes(sequence)
        frame = columns["frame"]
        boxes_px, depth_m = _projected(columns, poses, intrinsics_of(sequence))
        at = np.column_stack([columns["x_m"], columns["y_m"]]) - poses.xyz_m[frame, :2]
        forward, left = poses.forward[frame, :2], poses.left[frame, :2]
        ahead, aside = (at * forward).sum(axis=1), (at * left).sum(axis=1)
        # The long axis of a box is its y axis.
        along = np.column_stack([-np.sin(columns["yaw_rad"]), np.cos(columns["yaw_rad"])])
        turn = np.arctan2((along * left).sum(axis=1), (along * forward).sum(axis=1))
        focal, _, center, _ = intrinsics_of(sequence)
        column_px = center - focal * aside / np.maximum(ahead, 1e-9)
        kept = np.isin(columns["label"], VEHICLES) & (ahead > 0.0) & (ahead < REACH_M)
        kept &= (column_px >= 0.0) & (column_px < WIDTH_PX)
        self.frame: Final = frame[kept]
        self.ahead_m: Final[Floats] = ahead[kept]
        self.turn_deg: Final[Floats] = np.degrees(turn[kept])
        self.motion: Final = columns["motion"][kept]
        self.visible: Final[Floats] = _visible(frame, boxes_px, depth_m)[kept]
        self.outline_px: Final[Floats] = boxes_px[kept]
        self.at_m: Final[Floats] = at[kept]
        """Positions relative to the camera, along the map's axes."""

    def across(self, motion: str, *, to_left: bool) -> NDArray[np.bool_]:
        """Return a mask of the vehicles across the road with this motion, by heading."""
        turn = self.turn_deg if to_left else -self.turn_deg
        is_across = (turn > ACROSS_DEG) & (turn < 180.0 - ACROSS_DEG)
        return np.asarray(is_across & (self.motion == motion))

    def along(self, *, oncoming: bool) -> NDArray[np.bool_]:
        """Return a mask of the vehicles that move along the road, by heading."""
        off = np.abs(self.turn_deg)
        heads = off > 180.0 - ACROSS_DEG if oncoming else off < ACROSS_DEG
        return np.asarray(heads & (self.motion == "Moving"))


def annotate_sequence(sequence: Path, folder: Path = FOLDER) -> Path:
    """Write the truth of the sequence.

    Raises:
        LogFormatError: The sequence has no poses.
        OutputError: It cannot be written.
    """
    poses = read_pandaset_poses(sequence)
    boxes = VehicleBoxes(sequence, poses)
    start_ns, end_ns = int(poses.t_ns[0]), int(poses.t_ns[-1]) + 1
    gone_m = _travelled_m(poses)
    # Distance of each vehicle from the camera in the first frame, like crosswalk and kerb.
    past = boxes.ahead_m + gone_m[boxes.frame] > FAR_KERB_M
    seen = {
        "cross_traffic_left": boxes.across("Moving", to_left=True),
        "cross_traffic_right": boxes.across("Moving", to_left=False),
        "parked_left": boxes.across("Parked", to_left=True),
        "parked_right": boxes.across("Parked", to_left=False),
        "oncoming_cars": past & boxes.along(oncoming=True),
        "outgoing_cars": past & boxes.along(oncoming=False),
        "vehicles_past": past,
    }
    cues = [
        span
        for name, rows in seen.items()
        for span in _spans(name, poses, boxes, rows, with_visible=name in ALONG)
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
    "crossing; vehicles_past, oncoming_cars and outgoing_cars count boxes, hidden ones included"
)


def _spans(
    cue: str,
    poses: PandasetPoses,
    boxes: VehicleBoxes,
    rows: NDArray[np.bool_],
    *,
    with_visible: bool,
) -> list[CueTruth]:
    """Return runs of frames with equal truth as adjacent spans; visibility is in tenths."""
    present = np.bincount(boxes.frame[rows], minlength=len(poses.t_ns)) > 0
    visible = np.zeros(len(present))
    np.maximum.at(visible, boxes.frame[rows], boxes.visible[rows])
    visible = np.round(visible, 1) if with_visible else np.zeros(len(present))
    changes = (np.diff(present) != 0) | (np.diff(visible) != 0.0)
    starts = [0, *(np.flatnonzero(changes) + 1).tolist()]
    times = [*poses.t_ns[starts].tolist(), int(poses.t_ns[-1]) + 1]
    return [
        CueTruth(
            cue=cue,
            present=bool(present[first]),
            start_ns=times[i],
            end_ns=times[i + 1],
            approach=1,
            count=None if present[first] else 0,
            visible=float(visible[first]) if with_visible and present[first] else None,
        )
        for i, first in enumerate(starts)
    ]


def _travelled_m(poses: PandasetPoses) -> Floats:
    steps = np.linalg.norm(np.diff(poses.xyz_m[:, :2], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _ranges(poses: PandasetPoses, gone_m: Floats, camera_x_m: float) -> str:
    """Return the ranges of the rear axle at every picture as CSV text."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("t_ns", "approach", "start_m", "end_m"))
    for t_ns, gone in zip(poses.t_ns.tolist(), gone_m.tolist(), strict=True):
        start, end = (there + camera_x_m - gone for there in (CROSSWALK_M, FAR_KERB_M))
        rows.writerow((t_ns, 1, f"{start:.2f}", f"{end:.2f}"))
    return text.getvalue()


def _projected(
    boxes: dict[str, Any], poses: PandasetPoses, intrinsics: tuple[float, float, float, float]
) -> tuple[Floats, Floats]:
    """Return outlines of N boxes in their pictures, shape (N, 4), and depths of their centres."""
    focal, _, center_x, center_y = intrinsics
    depth, leftwards, up = np.moveaxis(corners_m(boxes, poses), 2, 0)
    depth = np.maximum(depth, 0.1)
    x, y = center_x - focal * leftwards / depth, center_y - focal * up / depth
    outlines = np.stack([x.min(1), y.min(1), x.max(1), y.max(1)], axis=1)
    forward = poses.forward[boxes["frame"]]
    return outlines, np.asarray((middles_m(boxes, poses) * forward).sum(axis=1))


def _visible(frame: NDArray[np.int64], boxes_px: Floats, depth_m: Floats) -> Floats:
    """Return the fractions of N outlines that no nearer one of the frame covers, on a grid."""
    found = np.ones(len(frame))
    steps = (np.arange(GRID) + 0.5) / GRID
    for i, (x0, y0, x1, y1) in enumerate(boxes_px.tolist()):
        nearer = boxes_px[(frame == frame[i]) & (depth_m > 0.0) & (depth_m < depth_m[i] - BEHIND_M)]
        x, y = np.meshgrid(x0 + steps * (x1 - x0), y0 + steps * (y1 - y0))
        covered = np.zeros(x.shape, np.bool_)
        for near in nearer:
            covered |= (x >= near[0]) & (x <= near[2]) & (y >= near[1]) & (y <= near[3])
        found[i] = 1.0 - covered.mean()
    return found


if __name__ == "__main__":
    print(annotate_sequence(*map(Path, sys.argv[1:3])))
