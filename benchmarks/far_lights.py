"""The range to the end of an intersection against the lights that face the car, on PandaSet.

The truth has no lights. Bearings of each light's boxes along the published poses place it; the
run's ranges to the end are then compared with every light that is placed well.

    crosscue replay pandaset_002 --vehicle pandaset.toml -o run
    python benchmarks/far_lights.py pandaset_002 run [--camera-ahead 1.8]
"""

import argparse
import json
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from crosscue.replay.columns import Floats

# Pictures and s.d. that place a light well; pixels of a bearing.
LEAST_PICTURES: Final = 20
PLACED_SD_M: Final = 3.5
BEARING_SD_PX: Final = 1.5
# Mean residual of the bearings, above which the boxes are not those of one light.
ONE_LIGHT_RAD: Final = 0.002


def placed(at_m: Floats, bearings: Floats, sd_rad: float) -> tuple[Floats, Floats, float]:
    """Return the point nearest to all bearings, its covariance, and the mean residual in rad."""
    weight = np.ones(len(at_m))
    for _ in range(30):
        across = np.eye(3) - bearings[:, :, None] * bearings[:, None, :]
        across *= weight[:, None, None]
        point = np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, at_m))
        weight = 1.0 / np.maximum(np.sum((point - at_m) ** 2, axis=1), 1.0)
    seen = (point - at_m) * np.sqrt(weight)[:, None]
    off = np.arccos(np.clip(np.sum(seen * bearings, axis=1), -1.0, 1.0))
    return point, np.linalg.inv(across.sum(0)) * sd_rad**2, float(off.mean())


def main() -> None:
    """Print each light's place and the errors of the range to the end against it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("sequence", type=Path, help="folder of the PandaSet sequence")
    parser.add_argument("run", type=Path, help="folder of its run")
    parser.add_argument("--camera-ahead", type=float, default=1.8, help="of the rear axle, m")
    args = parser.parse_args()
    camera = args.sequence / "camera" / "front_camera"
    poses = json.loads((camera / "poses.json").read_text(encoding="utf-8"))
    lens = json.loads((camera / "intrinsics.json").read_text(encoding="utf-8"))
    at_m = np.array([[one["position"][k] for k in "xyz"] for one in poses])
    turned = Rotation.from_quat([[one["heading"][k] for k in "xyzw"] for one in poses])
    forward = turned.apply([0.0, 0.0, 1.0])
    table: dict[str, Any] = pq.read_table(args.run / "ranged_objects.parquet").to_pydict()
    columns = {name: np.array(values) for name, values in table.items()}
    times = pq.read_table(args.run / "frames.parquet", columns=["t_ns"])["t_ns"].to_numpy()
    frame = np.searchsorted(np.sort(times), columns["t_ns"])
    u, v = (0.5 * (columns[f"{axis}0"] + columns[f"{axis}1"]) for axis in "xy")
    rays = np.stack([(u - lens["cx"]) / lens["fx"], (v - lens["cy"]) / lens["fy"]], axis=1)
    rays = np.column_stack([rays, np.ones(len(rays))])
    rays = turned[frame].apply(rays / np.linalg.norm(rays, axis=1)[:, None])
    end = columns["reference"] == "end"
    print(f"{end.sum()} ranges to the end, from {args.camera_ahead} m behind the camera")
    for light in np.unique(columns["object"]):
        own = columns["object"] == light
        if own.sum() < LEAST_PICTURES or "away" in columns["facing"][own]:
            continue
        seen_from = at_m[frame[own]]
        point, cov, off_rad = placed(seen_from, rays[own], BEARING_SD_PX / lens["fx"])
        ahead = forward[0]
        sd_m = float(np.sqrt(ahead @ cov @ ahead))
        if sd_m > PLACED_SD_M or off_rad > ONE_LIGHT_RAD:
            continue
        there = np.sum((point - at_m[frame[end]]) * forward[frame[end]], axis=1)
        there += args.camera_ahead
        error = columns["range_m"][end] - there
        first_m, worst = float((point - at_m[0]) @ ahead), 100.0 * np.abs(error / there).max()
        print(
            f"light {light}: {first_m:.1f} +- {sd_m:.1f} m ahead of the first picture; "
            f"bias {error.mean():+.1f} m, worst {worst:.1f} %"
        )


if __name__ == "__main__":
    main()
