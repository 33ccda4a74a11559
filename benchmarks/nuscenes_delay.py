"""Delays of a real nuScenes drive by `crosscue fit odometry`, from its CAN expansion alone.

The positions of ``can/pose`` become the scene's true poses, in tables of the published schema
without pictures. The fit then gives the delay of the wheel speeds, and that of the velocity which
``can/pose`` states, against these positions.

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
from crosscue.replay.vehicle.vehicle import Topics, Vehicle

RATE: Final = 5  # of the rows of can/pose, 50 Hz, every fifth is a true pose
SPEEDS: Final = {"wheel speeds": "can/wheel_speed", "velocity of can/pose": "can/pose"}


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


def main() -> None:
    """Print the fits."""
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
        for name, topic in SPEEDS.items():
            vehicle = Vehicle(version=1, topics=Topics(odometry=topic))
            found = crosscue.fit_odometry(root, vehicle, truth=truth, keep=True)
            print(f"\n{name}\n{found}")


if __name__ == "__main__":
    main()
