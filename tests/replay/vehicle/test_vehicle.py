"""Settings of a vehicle file that are refused or decide what is used."""

import pytest

from crosscue.replay.errors import VehicleError
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.signals.plan import plan
from crosscue.replay.vehicle.vehicle import Compass, Vehicle, parse
from support.memory_log import MAGNETOMETER


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
        (
            "version = 1\n\n[can.wheel_speeds]\nunit = 'm/s'",
            r":3: can.wheel_speeds.rear_left, can.wheel_speeds.rear_right: missing; add them$",
        ),
        ("version = 1\n[odometry]\nwheelbase_m = '2.7'", r":3: .*valid number, got '2.7'"),
        ("version = 1\n[odometry]\nwheelbase_m = -2.7", r":3: .*greater than 0"),
        ("version = 1\n[odometry]\nwheelbase_m = nan", r":3: odometry.wheelbase_m"),
        ("version = 1\n[ranges]\nkind = 'motion'", r":2: ranges: .*needs camera.focal_px"),
        ("version = 2", r":1: version: .*1, got 2"),
        ("version = 1\n[can.yaw_rate]\nsignal = 'YAW'", r":3: can.yaw_rate.signal"),
        ("version = 1\nversion = 1", r"not TOML: .*"),
        ("version = 1\n[hitch]\nx = 1", r":2: hitch: no such key; there are: .*topics"),
    ],
)
def test_invalid_setting_is_refused_with_line_number(text: str, message: str) -> None:
    with pytest.raises(VehicleError, match=message):
        parse(text, "car.toml")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("[fusion.cues]\nstop_sgn = { can_start = true }", r"did you mean stop_sign\?.*there"),
        (
            "[fusion.cues]\nstripes = { precision = 0.8, supports = ['strait'] }",
            r"stripes: no feature 'strait' \(did you mean straight\?\); there are: intersection",
        ),
        ("[fusion.cues]\nstripes = { precision = 0.8 }", "neither supports nor excludes"),
        ("[fusion.cues]\nroad_left = { excludes = ['left'] }", "road_left: a feature occurs twice"),
        ("[fusion.cues]\nroad_left = { precision = 1.0 }", "precision: .*less than 1"),
        ("[fusion.cues]\nroad_left = { precission = 0.5 }", "precission: no such key"),
        ("[fusion.cues]\nroad_left = 0.5", "road_left: "),
        ("[fusion]\ncues = 3", "fusion.cues"),
        ("[fusion.features]\nestablished = {}", "established: a column of the belief table"),
        ("[fusion.features]\n'Big Road' = {}", "pattern"),
        (
            "[fusion.features]\nleft = { use = false }\nright = { use = false }\n"
            "intersection = { use = false }",
            "none establishes presence",
        ),
        ("[fusion]\nreference = 'middle'", "reference"),
        ("[fusion]\nkind = 'best'", "kind"),
    ],
)
def test_invalid_fusion_setting_is_refused_with_hint(text: str, match: str) -> None:
    with pytest.raises(VehicleError, match=match):
        parse("version = 1\n" + text, "car.toml")


@pytest.mark.parametrize(
    ("compass", "is_used"),
    [
        (Compass(), False),
        (Compass(use=True), True),
        (Compass(hard_iron_t=(1e-5, 0.0, 0.0)), True),
        (Compass(hard_iron_t=(1e-5, 0.0, 0.0), use=False), False),
    ],
)
def test_magnetometer_is_used_if_calibrated_or_requested(compass: Compass, is_used: bool) -> None:
    vehicle = Vehicle(version=1, compass=compass)

    planned = plan([(0, MAGNETOMETER)], vehicle)

    assert (planned.source_of(Signal.MAGNETIC_FIELD) is not None) == is_used
    assert Vehicle(**vehicle.model_dump()).compass.uses_magnetometer == is_used
