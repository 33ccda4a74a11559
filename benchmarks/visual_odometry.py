"""Visual odometry against true poses: standing, yaw a frame, and speed.

Run it as ``python -m benchmarks.visual_odometry [RUN ...]``. It reads the sequences of
``$CROSSCUE_DATA`` (or ``../shared/data``) that have poses. RUN is a run folder of a drive, whose
boxes of vehicles are then masked; without one nothing is masked.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.real_roads import DATA, DRIVES, Drive
from crosscue.eval.runs.folder import RunFolder
from crosscue.localization.visual_odometry import BODY, VisualOdometry, VisualStep
from crosscue.replay.columns import Floats
from crosscue.replay.vehicle.vehicle import parse

NAMES: Final = ("kitti_t_junction", "kitti_right_turn", "pandaset_002")
# Speed above which a pair counts as moving, and below which as standing.
MOVING_MPS, STANDING_MPS = 1.0, 0.05


class Truth(NamedTuple):
    """True motion between two pictures: distance along the camera's track, and yaw."""

    distance_m: Floats
    turn_rad: Floats


def truth_of(drive: Drive) -> Truth:
    """Return the motion by the published poses."""
    folder = DATA / "sequences" / drive.folder
    if drive.folder.startswith("kitti"):
        lines = folder.joinpath("poses.txt").read_text().splitlines()
        poses = np.array([[float(w) for w in line.split()[:12]] for line in lines])
        turns, xyz_m = poses.reshape(-1, 3, 4)[:, :, :3], poses.reshape(-1, 3, 4)[:, :, 3]
    else:
        tree = json.loads(folder.joinpath("camera/front_camera/poses.json").read_text())
        turns = Rotation.from_quat(
            [[one["heading"][axis] for axis in "xyzw"] for one in tree]
        ).as_matrix()
        xyz_m = np.array([[one["position"][axis] for axis in "xyz"] for one in tree])
    relative = np.einsum("nji,njk->nik", turns[:-1], turns[1:])
    moved = np.einsum("nji,nj->ni", turns[:-1], np.diff(xyz_m, axis=0)) @ BODY.T
    in_body = BODY @ relative @ BODY.T
    return Truth(
        np.linalg.norm(moved, axis=1) * np.sign(moved[:, 0]),
        np.arctan2(in_body[:, 1, 0], in_body[:, 0, 0]),
    )


def steps_of(drive: Drive, boxes: Sequence[Floats]) -> list[VisualStep]:
    """Run the odometry over a drive's pictures."""
    camera = parse(f"version = 1\n[camera]\n{drive.camera}", drive.folder).camera
    odometry, found = VisualOdometry(camera), []
    for i, path in enumerate(sorted((DATA / "sequences" / drive.folder).glob(drive.pictures))):
        grey = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
        mask = boxes[i] if i < len(boxes) else np.empty((0, 4))
        step = odometry(round(i / drive.rate_hz * 1e9), grey, mask)
        if step is not None:
            found.append(step)
    return found


def boxes_of(run: Path) -> list[Floats]:
    """Return the boxes of vehicles and people of a run, by frame."""
    folder = RunFolder(run)
    rows = folder.table("detections").to_pylist()
    count = folder.table("frames").num_rows
    kinds = {"car", "truck", "bus", "motorcycle", "bicycle", "person", "train"}
    found: list[list[list[float]]] = [[] for _ in range(count)]
    for row in rows:
        if row["label"] in kinds:
            found[row["frame"]].append([row[name] for name in ("x0", "y0", "x1", "y1")])
    return [np.array(some).reshape(-1, 4) for some in found]


def main(arguments: Sequence[str]) -> None:
    """Print one line for each drive."""
    runs = {Path(run).name: Path(run) for run in arguments}
    for name in NAMES:
        drive = DRIVES[name]
        truth = truth_of(drive)
        steps = steps_of(drive, boxes_of(runs[name]) if name in runs else ())
        n = min(len(steps), len(truth.distance_m))
        mps = truth.distance_m[:n] * drive.rate_hz
        standing = np.array([step.is_standing for step in steps[:n]])
        is_still, is_moving = np.abs(mps) < STANDING_MPS, mps > MOVING_MPS
        turn = np.degrees([step.turn_rad for step in steps[:n]])
        off = turn - np.degrees(truth.turn_rad[:n])
        distance = np.array([step.distance_m for step in steps[:n]])
        sd = np.array([step.distance_sd_m for step in steps[:n]])
        error = (distance - truth.distance_m[:n])[is_moving]
        known = np.isfinite(error)
        share = error[known] / truth.distance_m[:n][is_moving][known]
        print(
            f"{name:18} standing {standing[is_still].sum()} of {is_still.sum()}, moving taken for "
            f"standing {standing[is_moving].sum()} of {is_moving.sum()}; yaw rms "
            f"{np.sqrt(np.nanmean(off**2)):.3f} worst {np.nanmax(np.abs(off)):.2f} deg, sum "
            f"{np.nansum(turn):.1f} of {np.degrees(truth.turn_rad[:n].sum()):.1f}; distance known "
            f"{known.sum()}, bias {np.mean(share):+.1%}, rms {np.sqrt(np.mean(share**2)):.1%}, "
            f"within 10 % {np.mean(np.abs(share) < 0.1):.0%}, inside 2 s.d. "
            f"{np.mean(np.abs(error[known]) < 2 * sd[is_moving][known]):.0%}; pitch "
            f"{steps[-1].pitch_rad:+.4f}"
        )
        if "-v" in sys.argv:
            for i, step in enumerate(steps[:n]):
                print(
                    i,
                    f"{truth.distance_m[i]:.3f} {step.distance_m:.3f} {step.distance_sd_m:.3f}",
                    f"{np.degrees(truth.turn_rad[i]):.2f} {turn[i]:.2f}",
                    step[6:],
                )


if __name__ == "__main__":
    main([word for word in sys.argv[1:] if word != "-v"])
