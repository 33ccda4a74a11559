"""Smoothed ranges, and the noise of simulated drives."""

from pathlib import Path

import numpy as np

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive
from crosscue.eval.pipeline.whole_run import replay_drive
from crosscue.eval.report.summary import poses_summary
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import create
from crosscue.eval.runs.tables.travelled import Odometer, OdometryRow
from crosscue.eval.scoring.columns import RangeRows
from crosscue.eval.scoring.consistency import mean_band
from crosscue.eval.scoring.intervals import TOO_FEW
from crosscue.eval.scoring.scene.ranges import smoothed_rows
from crosscue.eval.studies.town.field_study import score_pose
from crosscue.fusion.intersection_range import RangeBelief, initialise, predict, update
from crosscue.replay.columns import Floats
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.vehicle import load

SENSOR_M2, WAY_M2, STEP_M, STEP_NS = 4.0, 0.01, 1.0, 100_000_000


def odometer(steps: int) -> Odometer:
    start = np.arange(steps, dtype=np.int64) * STEP_NS
    same = np.full(steps, STEP_M), np.zeros(steps), np.full(steps, WAY_M2)
    columns = (start, start + STEP_NS, *same, np.zeros(steps, np.bool_))
    return Odometer(map(OdometryRow._make, zip(*(one.tolist() for one in columns), strict=True)))


def filtered(measured_m: Floats) -> list[RangeBelief]:
    found = [initialise(float(measured_m[0]), SENSOR_M2)]
    for value in measured_m[1:].tolist():
        found.append(update(predict(found[-1], STEP_M, WAY_M2), value, SENSOR_M2))
    return found


def rows(beliefs: list[RangeBelief]) -> RangeRows:
    n = len(beliefs)
    mean_m, var_m2 = np.array(beliefs).T
    t_ns = np.arange(n, dtype=np.int64) * STEP_NS + STEP_NS
    return RangeRows(t_ns, np.ones(n, np.int64), np.full(n, "start"), mean_m, var_m2)


def test_range_smoother_is_more_accurate_than_filter() -> None:
    rng = np.random.default_rng(seed=3)
    true_m = 60.0 - STEP_M * np.arange(50)
    filter_m2, smoother_m2 = [], []
    for _ in range(20):
        before = rows(filtered(true_m + rng.normal(0.0, 2.0, 50)))
        after = smoothed_rows(before, odometer(51))
        filter_m2.append(np.mean((before.range_m - true_m) ** 2))
        smoother_m2.append(np.mean((after.range_m - true_m) ** 2))
        assert after.range_m[-1] == before.range_m[-1]
        assert (after.var_m2 <= before.var_m2 + 1e-12).all()

    assert np.mean(smoother_m2) < 0.8 * np.mean(filter_m2)


DRIVES = 6


def test_nees_of_simulated_drives_is_in_band(tmp_path: Path) -> None:
    poses = []
    for seed in range(DRIVES):
        files = write_drive(tmp_path / str(seed), DriveSettings(seed=seed, blocks=1, block_m=70.0))
        with open_log(files.log) as log:
            run = create(tmp_path / f"run {seed}", overwrite=False)
            found = replay_drive(Drive([log], load(files.vehicle)), run).run
        poses.append(score_pose(found, files.truth))

    low, high = mean_band(3, DRIVES)
    assert low < np.mean([one.nees_xyh.mean for one in poses]) < high
    text = poses_summary(poses, np.arange(DRIVES))
    assert f"{DRIVES} drives, 0 lost" in text
    assert "NEES of x, y, heading" in text
    assert TOO_FEW not in text
    assert TOO_FEW in poses_summary(poses, np.arange(DRIVES) // 2)
