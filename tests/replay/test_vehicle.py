"""A vehicle file is validated when loaded, and the error names the line."""

import pytest

from crosscue.replay.errors import VehicleError
from crosscue.replay.vehicle.vehicle import parse


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("version = 1\n[odometry]\nwheel_scal = 1.0", r"car.toml:3: odometry.* wheel_scale"),
        (
            'version = 1\n[odometry.constants]\nnames = ["wheel_scale"]\ncovariance = [[1.0, 0.0]]',
            r"constants: value error, covariance: expected 1 rows of 1 numbers, one for each name",
        ),
        (
            'version = 1\n[odometry.constants]\nnames = ["wheel_scale"]\ncovariance = [[-1.0]]',
            r"covariance of wheel_scale and wheel_scale: -1, not that of any errors",
        ),
        ("version = 1\n[compass]\nheading_sd_deg = 3.0", r":3: .*did you mean heading_sd_rad"),
        ("version = 1\n\n[can.wheel_speeds]\nrear_left = 'A.B'", r":3: .*rear_right: missing"),
        ("version = 1\n[odometry]\nwheelbase_m = '2.7'", r":3: .*valid number, got '2.7'"),
        ("version = 1\n[odometry]\nwheelbase_m = -2.7", r":3: .*greater than 0"),
        ("version = 1\n[odometry]\nwheelbase_m = nan", r":3: odometry.wheelbase_m"),
        ("version = 1\n[ranges]\nkind = 'motion'", r":2: ranges: .*needs camera.focal_px"),
        ("version = 2", r":1: version: .*1, got 2"),
        ("version = 1\n[can.yaw_rate]\nsignal = 'YAW'", r":3: can.yaw_rate.signal"),
        ("version = 1\nversion = 1", r"not TOML: .*"),
        ("version = 1\n[radar]\nx = 1", r":2: radar: no such key; there are: .*topics"),
    ],
)
def test_invalid_setting_is_refused_with_line_number(text: str, message: str) -> None:
    with pytest.raises(VehicleError, match=message):
        parse(text, "car.toml")
