"""The pose filter is consistent with the noise settings of the simulator."""

from pathlib import Path

import numpy as np

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive
from crosscue.eval.pipeline.whole_run import replay_drive
from crosscue.eval.report.summary import poses_summary
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import create
from crosscue.eval.scoring.consistency import mean_band
from crosscue.eval.scoring.intervals import TOO_FEW
from crosscue.eval.studies.town.replayed import score_pose
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.vehicle import load

DRIVES = 4


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
    assert "4 drives, 0 lost" in text
    assert "NEES of x, y, heading" in text
    assert TOO_FEW not in text
    assert TOO_FEW in poses_summary(poses, np.arange(DRIVES) // 4)
