"""Noise derived from the simulator's own settings makes the pose as wrong as it says."""

from pathlib import Path

import numpy as np

from crosscue.datasets.scenes.car_file import with_fitted_noise
from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive
from crosscue.eval.pipeline.replay import replay_drive
from crosscue.eval.runs.folder import create
from crosscue.eval.scoring.consistency import mean_band
from crosscue.eval.studies.town.replayed import score_pose
from crosscue.replay.base import EVERYTHING
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.vehicle import load

DRIVES = 4


def test_simulated_drives_are_as_wrong_as_their_noise_says(tmp_path: Path) -> None:
    nees = []
    for seed in range(DRIVES):
        settings = DriveSettings(seed=seed, blocks=1, block_m=70.0)
        files = write_drive(tmp_path / str(seed), settings)
        text = files.vehicle.read_text("utf-8")
        files.vehicle.write_text(with_fitted_noise(text, seed, files.metres))
        with open_log(files.log) as log:
            run = create(tmp_path / f"run {seed}", overwrite=False)
            found = replay_drive([log], load(files.vehicle), run, EVERYTHING).run
        nees.append(score_pose(found, files.truth).nees_xyh.mean)

    low, high = mean_band(3, DRIVES)
    assert low < np.mean(nees) < high
