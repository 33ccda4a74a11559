"""Ranges to a real intersection: decreasing, inside their own interval, and accurate."""

import numpy as np
import pytest

from crosscue.eval.cli import run
from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.replay.columns import Floats
from support.data import shared

CAR = """
version = 1
[camera]
x_m = 1.8
z_m = 1.8
focal_px = 1970.0
center_px = [970.0, 483.3]
"""
CAMERA_M = 1.8
# Distance from the first frame's camera to the far kerb and the crosswalk, each within 2.5 m.
TRUTH_M = {"end": 79.0, "start": 59.0}


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    log, weights = shared("sequences", "pandaset_002"), shared("weights", "yolox_nano")
    folder = tmp_path_factory.mktemp("real")
    (folder / "car.toml").write_text(CAR)
    argv = ["replay", str(log), "--vehicle", str(folder / "car.toml"), "-o", str(folder / "run")]
    cache = ["--cache", str(folder / "cache.sqlite")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSCUE_DATA", str(weights.parents[1]))
        patch.setenv("CROSSCUE_MODELS", str(folder / "models"))
        assert run(["model", "fetch", "yolox-nano"]) == 0
        assert run([*argv, "--detectors", "yolox-nano", *cache]) == 0
    return open_run(folder / "run")


def columns(drive: RunFolder, reference: str) -> tuple[Floats, Floats, Floats]:
    """Ranges, their standard deviations and the distance travelled, by row."""
    table = drive.table("range")
    pose = drive.table("pose", ["t_ns", "travelled_m"])
    gone = dict(zip(pose["t_ns"].to_pylist(), pose["travelled_m"].to_pylist(), strict=True))
    rows = [row for row in table.to_pylist() if row["reference"] == reference]
    return (
        np.array([row["range_m"] for row in rows]),
        np.sqrt([row["var_m2"] for row in rows]),
        np.array([gone.get(row["t_ns"], 0.0) for row in rows]),
    )


@pytest.mark.slow
@pytest.mark.parametrize("reference", ["end", "start"])
def test_range_decreases_and_interval_contains_truth(drive: RunFolder, reference: str) -> None:
    range_m, sd_m, gone_m = columns(drive, reference)
    true_m = TRUTH_M[reference] + CAMERA_M - gone_m

    # The car stands in its first 23 of 80 frames, in which no approach opens. One light marks the
    # start, and its assumed size is no range until growth confirms it.
    assert len(range_m) >= {"end": 55, "start": 15}[reference]
    steps_m, moved_m = np.diff(range_m), np.diff(gone_m)
    # While the vehicle stands, wheels and poses move back by millimetres.
    assert (steps_m <= np.maximum(-moved_m, 0.0) + 0.01).all()
    assert (np.abs(range_m - true_m) < 1.96 * sd_m).all()
    assert (np.abs(range_m / true_m - 1.0) < 0.1).all()
    assert sd_m[-1] < 0.8 * sd_m[0]
