"""``fit odometry`` on a simulated drive, from log files to a vehicle file."""

from __future__ import annotations

import pytest

import crosscue
from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import DriveFiles, write_drive
from crosscue.eval.fit.odometry import FittedOdometry

BIAS = 0.002


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> DriveFiles:
    settings = DriveSettings(seed=3, blocks=6, gyro_bias_radps=BIAS)
    return write_drive(tmp_path_factory.mktemp("drive"), settings)


@pytest.fixture(scope="module")
def fitted(files: DriveFiles) -> FittedOdometry:
    calibrated = files.vehicle.read_text().splitlines(keepends=True)
    vehicle, output = (files.vehicle.with_name(f"{name}.toml") for name in ("any", "fitted"))
    kept = [line for line in calibrated if not line.startswith(("gyro_", "slip_", "scale_sd"))]
    vehicle.write_text("".join(kept))
    return crosscue.fit_odometry(files.log, vehicle, output, truth=files.truth)


def test_simulated_gyro_bias_is_estimated(fitted: FittedOdometry) -> None:
    fit = fitted.fitted.sources[0].fit
    (bias,) = (one for one in fit.fitted if one.parameter == "gyro_bias_radps")

    assert abs(bias.value - BIAS) < 4.0 * bias.sd


def test_fit_reduces_held_out_error_and_nees_is_within_band(
    fitted: FittedOdometry,
) -> None:
    one = fitted.fitted.sources[0]

    assert one.after.held_out_m < one.before.held_out_m
    assert one.after.all_nees < fitted.fitted.nees_band[1]
