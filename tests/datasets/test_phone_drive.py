"""A phone on the dashboard: axes, clocks and units, and the effects of damage."""

import math
from pathlib import Path

import pytest

from crosscue.replay.errors import LogFormatError
from crosscue.replay.logs.opening import open_log
from support.accounted import column, read, read_topics, times
from support.phone_drive import LATE_S, START_S, YAW_RATE_RADPS, phone_drive

ZONE_S = -5 * 3600


def test_rows_have_the_axes_of_the_car_and_the_times_of_the_wall_clock(tmp_path: Path) -> None:
    found, _ = read_topics(phone_drive(tmp_path / "drive"))

    # About the vertical, although the phone is tilted.
    first, *_, last = column(found["phone/gyro"], "yaw_rate_radps")
    assert (first, last) == (0.0, pytest.approx(YAW_RATE_RADPS, abs=1e-8))
    assert column(found["phone/gnss"], "course_rad")[0] == pytest.approx(-math.pi / 2)
    # A position has the time of its fix.
    assert len(t_ns := times(found["phone/gnss"])) == 6
    assert t_ns[0] * 1e-9 == pytest.approx(START_S + ZONE_S - LATE_S)
    assert times(found["car/speed"])[0] * 1e-9 == pytest.approx(START_S + ZONE_S, abs=0.1)


def test_damaged_phone_line_is_dropped_from_each_of_its_topics(tmp_path: Path) -> None:
    drive = phone_drive(tmp_path / "drive")
    file = drive / "made_phone.csv"
    lines = file.read_text(encoding="utf-8").splitlines()
    lines[10] = "rubbish"
    file.write_text("\n".join(lines), encoding="utf-8")

    blocks, ledger = read(drive)

    assert sum(map(len, blocks)) == 3 * 60 + 2 * 59 + 6
    assert ledger.topic("phone/gyro").dropped.total() == 1
    assert ledger.topic("phone/magnetometer").dropped.total() == 1
    # The line may or may not have contained a new position.
    assert ledger.topic("phone/gnss").dropped_unknown


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        ("car", None, "expected one file *_car.csv, found none"),
        ("car", ("Speed (MPH)", "Speed"), "no column 'Speed (MPH)'"),
        ("phone", ("motionGravity", "gravity"), "'motionGravityX(G)', 'motionGravityY(G)'"),
    ],
)
def test_missing_file_or_column_is_refused_with_its_name(
    kind: str, change: tuple[str, str] | None, message: str, tmp_path: Path
) -> None:
    drive = phone_drive(tmp_path / "drive")
    file = drive / f"made_{kind}.csv"
    if change is None:
        file.unlink()
    else:
        file.write_text(file.read_text(encoding="utf-8").replace(*change), encoding="utf-8")

    with pytest.raises(LogFormatError) as caught:
        open_log(drive)
    assert message in str(caught.value)
