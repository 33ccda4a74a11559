"""Delays of a real nuScenes drive by `crosscue fit odometry`, from its CAN expansion alone.

The positions of ``can/pose`` become the scene's true poses, in tables of the published schema
without pictures. Printed are `crosscue fit odometry` as it is, and fits to the whole drive with
positions every 0.2 s: the delay of the wheel speeds, and of the velocity that ``can/pose`` states.

    python benchmarks/nuscenes_delay.py FOLDER   # with scene-NNNN_pose.json, ..._zoe_veh_info.json
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from pathlib import Path
from typing import Final

import crosscue
from crosscue.datasets.adapters.nuscenes import RPM_TO_MPS
from crosscue.eval.fit.log_signals import read_signals, signal_plan, turn_samples, wheel_speeds
from crosscue.eval.fit.reference import of_truth
from crosscue.eval.logs.log import opened
from crosscue.eval.pipeline.pose import odometry_settings
from crosscue.localization.fit.known_drive import KnownDrive
from crosscue.localization.fit.odometry import fit_odometry
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.vehicle.vehicle import Vehicle

# Of the rows of can/pose, 50 Hz, every fifth is a true pose.
RATE: Final = 5
SPACING_NS: Final = 200_000_000


def written(folder: Path, name: str, root: Path) -> None:
    """Write the data root of one scene."""
    shutil.copytree(folder, root / "can_bus")
    tables = root / "v1.0-mini"
    tables.mkdir()
    rows = json.loads((folder / f"{name}_pose.json").read_text(encoding="utf-8"))[::RATE]
    origin = rows[0]["pos"]
    poses, data = [], []
    for i, row in enumerate(rows):
        at = [value - first for value, first in zip(row["pos"], origin, strict=True)]
        pose = {"translation": at, "rotation": row["orientation"]}
        poses.append({"token": f"e{i}", "timestamp": row["utime"], **pose})
        data.append(
            {
                "token": f"d{i}",
                "sample_token": "p",
                "ego_pose_token": f"e{i}",
                "calibrated_sensor_token": "c",
                "timestamp": row["utime"],
                "fileformat": "jpg",
                "is_key_frame": i == 0,
                "height": 900,
                "width": 1600,
                "filename": f"sweeps/CAM_FRONT/{i}.jpg",
                "prev": "",
                "next": "",
            }
        )
    mounted = {"translation": [1.7, 0.0, 1.5], "rotation": [0.5, -0.5, 0.5, -0.5]}
    focal = [[1266.0, 0.0, 816.0], [0.0, 1266.0, 491.0], [0.0, 0.0, 1.0]]
    content = {
        "scene": [{"token": "s", "name": name}],
        "sensor": [{"token": "cam", "channel": "CAM_FRONT", "modality": "camera"}],
        "calibrated_sensor": [
            {"token": "c", "sensor_token": "cam", "camera_intrinsic": focal, **mounted}
        ],
        "sample": [{"token": "p", "timestamp": rows[0]["utime"], "scene_token": "s"}],
        "sample_data": data,
        "ego_pose": poses,
        "sample_annotation": [],
        "instance": [{"token": "i", "category_token": "k"}],
        "category": [{"token": "k", "name": "none"}],
        "attribute": [{"token": "a", "name": "none"}],
    }
    for table, lines in content.items():
        (tables / f"{table}.json").write_text(json.dumps(lines), encoding="utf-8")


def by_velocity(root: Path) -> None:
    """Replace the wheel speeds of a data root by the velocity that ``can/pose`` states."""
    (pose,) = (root / "can_bus").glob("*_pose.json")
    wheels = [f"{end}_wheel_speed" for end in ("FL", "FR", "RL", "RR")]
    rows = [
        {"utime": row["utime"], **dict.fromkeys(wheels, row["vel"][0] / RPM_TO_MPS)}
        for row in json.loads(pose.read_text(encoding="utf-8"))
    ]
    other = pose.with_name(pose.name.replace("_pose", "_zoe_veh_info"))
    other.write_text(json.dumps(rows), encoding="utf-8")


def delay(root: Path, truth: Path) -> str:
    """Return the delay by a fit to the whole drive, with positions every 0.2 s."""
    vehicle = Vehicle(version=1)
    with opened(root) as drive:
        planned = signal_plan(drive.logs, vehicle)
        wanted = [Signal.WHEEL_SPEEDS, Signal.YAW_RATE]
        found = read_signals(drive.logs, planned, vehicle, drive.selection, wanted)
    known = of_truth(truth, vehicle, SPACING_NS)
    turn = turn_samples(Signal.YAW_RATE, found)
    speeds = wheel_speeds(found[Signal.WHEEL_SPEEDS])
    fit = fit_odometry(
        KnownDrive(speeds, turn, known.fixes, known.lever_m), odometry_settings(vehicle)
    )
    at = fit.constants.names.index("wheel_delay_s")
    sd_s = float(fit.constants.cov[at, at]) ** 0.5
    late_s = -fit.value("fix_delay_s")
    why = dict(fit.not_observable).get("fix_delay_s", "observable")
    return f"late by {1e3 * late_s:.0f} +- {1e3 * sd_s:.0f} ms ({why}), {fit.fixes} positions"


def main() -> None:
    """Print the command's fit and the delays."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    (pose,) = folder.glob("scene-*_pose.json")
    with tempfile.TemporaryDirectory() as made:
        root = Path(made) / "root"
        root.mkdir()
        written(folder, pose.name.removesuffix("_pose.json"), root)
        truth = Path(made) / "truth"
        crosscue.write_truth(root, truth)
        print(crosscue.fit_odometry(root, Vehicle(version=1), truth=truth, keep=True))
        print(f"\nwheel speeds           {delay(root, truth)}")
        by_velocity(root)
        print(f"velocity of can/pose   {delay(root, truth)}")


if __name__ == "__main__":
    main()
