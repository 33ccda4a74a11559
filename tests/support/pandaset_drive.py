"""A simulated PandaSet sequence in the published layout: a constant turn at constant speed."""

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from support.pictures import picture

COUNT = 20
SPEED_MPS = 10.0
YAW_RATE_RADPS = 0.2
START_S = 1557539956.45
CAMERA_AHEAD_M = 1.8


def pandaset_drive(folder: Path, count: int = COUNT) -> Path:
    """Write a sequence; the camera is ``CAMERA_AHEAD_M`` ahead of the rear axle."""
    times = START_S + 0.1 * np.arange(count)
    yaw = YAW_RATE_RADPS * (times - START_S)
    radius = SPEED_MPS / YAW_RATE_RADPS
    axle = radius * np.column_stack([np.sin(yaw), 1.0 - np.cos(yaw)])
    camera = axle + CAMERA_AHEAD_M * np.column_stack([np.cos(yaw), np.sin(yaw)])
    # Rotation from the camera's axes (right, down, forward) to the vehicle's (forward, left, up).
    axes = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    wxyz = (Rotation.from_euler("z", yaw[:, None]) * axes).as_quat()[:, [3, 0, 1, 2]]
    place = folder / "camera" / "front_camera"
    place.mkdir(parents=True)
    for i in range(count):
        (place / f"{i:02d}.jpg").write_bytes(picture(i, ".jpg"))
    (place / "timestamps.json").write_text(json.dumps(times.tolist()))
    (place / "intrinsics.json").write_text('{"fx": 1970.0, "fy": 1972.0, "cx": 970.5, "cy": 483.0}')
    poses = [
        {"position": {"x": x, "y": y, "z": 1.8}, "heading": dict(zip("wxyz", turn, strict=True))}
        for (x, y), turn in zip(camera.tolist(), wxyz.tolist(), strict=True)
    ]
    (place / "poses.json").write_text(json.dumps(poses))
    (folder / "meta").mkdir()
    (folder / "meta" / "timestamps.json").write_text(json.dumps((times + 0.05).tolist()))
    fixes = [
        {"lat": 37.77, "long": -122.4, "height": 3.0, "xvel": 1.0, "yvel": 0.0, "azimuth": 45.0}
        for _ in range(count)
    ]
    (folder / "meta" / "gps.json").write_text(json.dumps(fixes))
    return folder
