"""The benchmark of far lights places a light by its bearings, and prints the error of a range."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from runpy import run_path
from typing import cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

BENCHMARK = Path(__file__).parents[3] / "benchmarks" / "far_lights.py"
FOCAL_PX, CENTER_PX = 1900.0, (960.0, 540.0)
LIGHT_M = np.array([70.0, 4.0, 5.0])
AHEAD_M, BIAS_M = 1.8, 2.0


def written(folder: Path) -> tuple[Path, Path]:
    """A drive of 40 m, straight towards a light, with poses each metre; the run has every frame."""
    camera, run = folder / "drive/camera/front_camera", folder / "run"
    camera.mkdir(parents=True)
    run.mkdir()
    # Camera axes (right, down, ahead) in a world with x ahead and y to the left.
    axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    heading = dict(zip("xyzw", Rotation.from_matrix(axes).as_quat().tolist(), strict=True))
    at_m = np.array([[float(i), 0.0, 1.6] for i in range(40)])
    poses = [
        {"position": dict(zip("xyz", one.tolist(), strict=True)), "heading": heading}
        for one in at_m
    ]
    (camera / "poses.json").write_text(json.dumps(poses))
    lens = {"fx": FOCAL_PX, "fy": FOCAL_PX, "cx": CENTER_PX[0], "cy": CENTER_PX[1]}
    (camera / "intrinsics.json").write_text(json.dumps(lens))
    t_ns = [1_000_000_000 + 100_000_000 * i for i in range(40)]
    # A run with odometry lists its frames in another order than that of their times.
    pq.write_table(pa.table({"t_ns": t_ns[::-1]}), run / "frames.parquet")
    rows = []
    for i in range(40):
        x, y, z = (LIGHT_M - at_m[i]) @ axes
        u, v = CENTER_PX[0] + FOCAL_PX * x / z, CENTER_PX[1] + FOCAL_PX * y / z
        for number, facing in ((3, "toward"), (8, "away")):
            rows.append(
                {
                    "t_ns": t_ns[i], "object": number, "facing": facing, "x0": u - 4, "x1": u + 4,
                    "y0": v - 9, "y1": v + 9, "reference": "end" if number == 3 else "start",
                    "range_m": float(z) + AHEAD_M + BIAS_M,
                }
            )  # fmt: skip
    pq.write_table(pa.Table.from_pylist(rows), run / "ranged_objects.parquet")
    return folder / "drive", run


def test_far_light_is_placed_and_the_range_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sequence, run = written(tmp_path)
    main = cast("Callable[[], None]", run_path(str(BENCHMARK))["main"])
    monkeypatch.setattr(sys, "argv", ["far_lights.py", str(sequence), str(run)])

    main()

    head, *lights = capsys.readouterr().out.splitlines()
    assert head == "40 ranges to the end, from 1.8 m behind the camera"
    (line,) = lights
    assert line.startswith("light 3: 70.0 +- ")
    assert f"bias {BIAS_M:+.1f} m, worst {100.0 * BIAS_M / (31.0 + AHEAD_M):.1f} %" in line
