"""The commands' functions in Python: each returns a record whose repr is a table."""

import re
from pathlib import Path

import pytest

import crosscue
from crosscue.datasets.simulated.drive import dbc_path
from crosscue.replay.errors import EmptyResultError
from crosscue.replay.vehicle.vehicle import parse
from support.pandaset_drive import pandaset_drive


def test_vehicle_draft_has_published_intrinsics_and_commented_sections(tmp_path: Path) -> None:
    text = crosscue.draft_vehicle(pandaset_drive(tmp_path / "002", 4)).text

    assert "focal_px = 1970  # published with the data set\ncenter_px = [970.5, 483]" in text
    # The generated pictures are tiny.
    assert "# pitch and yaw not estimated: camera.center_px = (970.5, 483): outside the im" in text
    for section in ("mobileye", "regions", "ranges", "detectors.yolox-nano", "cues", "cars"):
        assert f"# [{section}]" in text
    # Every commented line is valid in a vehicle file when uncommented.
    lines = [line.removeprefix("# ") for line in text.splitlines()]
    kept = [line for line in lines if re.match(r"\[[\w.-]+\]( +#|$)|\w+ = ", line)]
    parse("\n".join(line for line in kept if 'kind = "curve"' not in line), "uncommented")


@pytest.mark.slow
def test_databases_for_a_log_without_a_bus_are_refused_with_the_types_that_are_there(
    tmp_path: Path,
) -> None:
    drive = pandaset_drive(tmp_path / "002", 4)

    with pytest.raises(EmptyResultError) as caught:
        crosscue.draft_vehicle(drive, [dbc_path()])

    text = str(caught.value)
    assert text.startswith(f"{drive}: no CAN bus for simulated_car.dbc; there are: ")
    assert "front_camera (crosscue/Images)" in text
    assert "can_msgs/msg/Frame" in text


def test_vehicle_draft_uses_intrinsics_of_calibration_message(tmp_path: Path) -> None:
    files = crosscue.simulate_approach(tmp_path, "L0", width_px=64)
    known = crosscue.load_vehicle(files.vehicle).camera

    drafted = crosscue.draft_vehicle(files.log).vehicle.camera

    assert drafted.focal_px == pytest.approx(known.focal_px)
    assert drafted.center_px == pytest.approx(known.center_px)


def test_vehicle_draft_keeps_specified_mounting(tmp_path: Path) -> None:
    log = pandaset_drive(tmp_path / "002", 4)

    camera = crosscue.draft_vehicle(
        log, camera_x_m=1.7, camera_height_m=1.4, camera_pitch_deg=2.0, camera_yaw_deg=-1.0
    ).vehicle.camera

    assert (camera.x_m, camera.z_m) == (1.7, 1.4)
    assert camera.pitch_rad == pytest.approx(0.0349, abs=1e-4)
    assert camera.yaw_rad == pytest.approx(-0.01745, abs=1e-4)
    with pytest.raises(crosscue.UsageError, match=r"^camera_height_m: -1, expected 0.1 to 10$"):
        crosscue.draft_vehicle(log, camera_height_m=-1.0)
    # Four tiny pictures have no vanishing point: a comment reports it, and the default is kept.
    text = crosscue.draft_vehicle(log).text
    assert "# pitch and yaw not estimated" in text
    assert "# pitch_rad = 0.0" in text
