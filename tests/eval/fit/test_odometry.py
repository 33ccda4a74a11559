"""``fit odometry`` on a simulated drive, from log files to a vehicle file."""

from __future__ import annotations

from pathlib import Path

import pytest

import crosscue
from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import DriveFiles, write_drive
from crosscue.eval import cli
from crosscue.replay.base import EmptyResultError

BIAS = 0.002


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> DriveFiles:
    settings = DriveSettings(seed=3, blocks=6, gyro_bias_radps=BIAS)
    return write_drive(tmp_path_factory.mktemp("drive"), settings)


@pytest.fixture(scope="module")
def fitted(files: DriveFiles) -> crosscue.FittedOdometry:
    output = files.vehicle.with_name("fitted.toml")
    return crosscue.fit_odometry(files.log, files.vehicle, output, truth=files.truth)


def test_the_bias_of_a_simulated_gyro_is_found(fitted: crosscue.FittedOdometry) -> None:
    fit = fitted.fitted.sources[0].fit
    (bias,) = (one for one in fit.fitted if one.parameter == "gyro_bias_radps")

    assert abs(bias.value - BIAS) < 4.0 * bias.sd


def test_the_held_out_half_is_nearer_to_the_truth_and_errors_are_as_large_as_claimed(
    fitted: crosscue.FittedOdometry,
) -> None:
    one = fitted.fitted.sources[0]

    assert one.after.held_out_m < one.before.held_out_m
    assert one.after.all_nees < fitted.fitted.nees_band[1]


def test_the_vehicle_file_says_where_its_odometry_comes_from(
    fitted: crosscue.FittedOdometry, files: DriveFiles
) -> None:
    assert fitted.path is not None
    written = crosscue.load_vehicle(fitted.path).odometry
    came_from = written.fitted

    assert written.gyro_bias_radps == fitted.section["gyro_bias_radps"]
    assert came_from is not None
    assert came_from.log == files.log.name
    assert came_from.start_ns < came_from.end_ns
    assert came_from.sd["gyro_bias_radps"] > 0.0
    assert files.vehicle.read_text().splitlines()[0] == fitted.path.read_text().splitlines()[0]


def test_a_log_without_positions_names_what_to_do(files: DriveFiles, tmp_path: Path) -> None:
    with pytest.raises(EmptyResultError, match=r"no positions to fit to: .*--truth"):
        crosscue.fit_odometry(files.log, files.vehicle, tmp_path / "out.toml")
    assert not (tmp_path / "out.toml").exists()


def test_an_output_without_a_vehicle_file_is_wrong_usage(
    files: DriveFiles, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["fit", "odometry", str(files.log), "-o", str(tmp_path / "out.toml")]

    assert cli.run(argv) == 2
    assert "give it as --vehicle" in capsys.readouterr().err
