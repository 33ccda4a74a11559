"""The signals of a vehicle may be on several buses, one per section of the vehicle file."""

from pathlib import Path
from typing import Final

import numpy as np
import pytest

from crosscue.replay.base import EVERYTHING
from crosscue.replay.columns import Block, Table, Topic
from crosscue.replay.ledger import Ledger
from crosscue.replay.signals.extractor import SampleExtractor
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.signals.plan import plan
from crosscue.replay.vehicle.drafting.camera import CameraMounting
from crosscue.replay.vehicle.drafting.observed import observe
from crosscue.replay.vehicle.drafting.text import draft_text, examine
from crosscue.replay.vehicle.vehicle import load, parse
from support.can_layouts import frames_of
from support.memory_log import MemoryLog
from support.trees import written

DBC: Final = """VERSION ""
BU_: A
BO_ 100 Wheels: 8 A
 SG_ WheelSpeedRL : 0|16@1+ (0.01,0) [0|0] "m/s" A
 SG_ WheelSpeedRR : 16|16@1+ (0.01,0) [0|0] "m/s" A
 SG_ SpeedOfCar : 32|16@1+ (0.01,0) [0|0] "m/s" A
BO_ 101 ESP: 8 A
 SG_ YawRate : 0|16@1- (0.01,0) [0|0] "deg/s" A
"""
N: Final = 800
T_NS: Final = np.arange(N, dtype=np.int64) * 50_000_000
YAW_RATE_DEGPS: Final = 12.0 * np.sin(0.4 * T_NS * 1e-9)


def frames(
    bus: str, arbitration_id: int, *values: np.ndarray[tuple[int], np.dtype[np.float64]]
) -> Block:
    data = np.zeros((N, 8), np.uint8)
    for place, column in enumerate(values):
        raw = np.rint(column * 100.0).astype("<i2").view(np.uint8).reshape(N, 2)
        data[:, 2 * place : 2 * place + 2] = raw
    return Block(bus, T_NS, frames_of(data, arbitration_id))


@pytest.fixture
def log() -> MemoryLog:
    """Return a log with wheel speeds and yaw rate on two buses, where identifier 100 differs."""
    speed, yaw = np.full(N, 10.0), np.deg2rad(YAW_RATE_DEGPS)
    left, right = speed - 0.775 * yaw, speed + 0.775 * yaw
    other = np.full(N, 77.0)
    topics = tuple(Topic(name, "crosscue/CanFrames", "columns") for name in ("body", "chassis"))
    course = np.cumsum(yaw) * 0.05
    fix = Table({"speed_mps": speed, "course_rad": course})
    return MemoryLog(
        (*topics, Topic("fix", "sensor_msgs/msg/NavSatFix", "columns")),
        [
            Block("fix", T_NS, fix),
            frames("body", 100, left, right, speed),
            frames("chassis", 101, YAW_RATE_DEGPS),
            frames("chassis", 100, other, other, other * np.linspace(0.0, 1.0, N)),
        ],
    )


@pytest.fixture
def dbc(tmp_path: Path) -> Path:
    return written(tmp_path / "car.dbc", DBC)


def test_each_section_is_read_from_its_bus(log: MemoryLog, dbc: Path) -> None:
    file = dbc.with_name("car.toml")
    file.write_text(
        'version = 1\n[can]\nbus = "body"\ndbc = ["car.dbc"]\n'
        '[can.wheel_speeds]\nrear_left = "Wheels.WheelSpeedRL"\n'
        'rear_right = "Wheels.WheelSpeedRR"\n'
        '[can.yaw_rate]\nbus = "chassis"\nsignal = "ESP.YawRate"\n'
    )
    vehicle = load(file)
    planned = plan([(0, topic) for topic in log.topics], vehicle)
    extract = SampleExtractor(planned, vehicle, 0, ledger := Ledger(""))

    found = [samples for block in log.read(ledger, EVERYTHING) for samples in extract(block)]

    wheels = [one for one in found if one.signal is Signal.WHEEL_SPEEDS]
    rates = [one for one in found if one.signal is Signal.YAW_RATE]
    assert len(wheels) == len(rates) == 1
    np.testing.assert_allclose(wheels[0].values[:, 2:].mean(axis=1), 10.0, atol=0.01)
    np.testing.assert_allclose(np.rad2deg(rates[0].values), YAW_RATE_DEGPS, atol=0.01)


@pytest.mark.parametrize("rows", [1, 2, 30])
def test_very_short_log_is_drafted_without_yaw_rate(log: MemoryLog, dbc: Path, rows: int) -> None:
    short = MemoryLog(log.topics, [block.take(slice(0, rows)) for block in log.blocks])

    can = parse(draft_text(examine([short], [dbc]), dbc.parent, CameraMounting()), "the draft").can

    assert can.bus is not None
    assert can.yaw_rate is None


def test_draft_names_every_bus_and_the_bus_of_each_signal(log: MemoryLog, dbc: Path) -> None:
    text = draft_text(examine([log], [dbc]), dbc.parent, CameraMounting())

    can = parse(text, "the draft").can
    assert can.bus == "body"
    assert can.wheel_speeds is not None
    assert can.wheel_speeds.bus is None
    assert can.yaw_rate is not None
    assert can.yaw_rate.bus == "chassis"
    assert "# body: 1 identifiers, 1 of them" in text
    assert "# chassis: 2 identifiers, 2 of them" in text
    # The same names on the other bus are listed with their contradictions.
    assert "not chosen: Wheels.WheelSpeedRL, Wheels.WheelSpeedRR on chassis" in text
    assert len(observe([log], None).buses) == 2


def test_database_of_another_bus_is_omitted_with_reason(
    log: MemoryLog, dbc: Path, tmp_path: Path
) -> None:
    """Two buses use one identifier for different messages; the file with the wheels is kept."""
    radar = tmp_path / "radar.dbc"
    radar.write_text('VERSION ""\nBU_: A\nBO_ 100 Track: 8 A\n SG_ Far : 0|8@1+ (1,0) [0|0] "" A\n')

    examined = examine([log], [radar, dbc])

    assert examined.databases == [dbc]
    text = draft_text(examined, tmp_path, CameraMounting())
    assert 'dbc = ["car.dbc"]' in text
    assert "# omitted, a file of another bus: radar.dbc: " in text
    assert "0x064" in text
    assert parse(text, "the draft").can.wheel_speeds is not None
    assert examine([log], [dbc]).left_out == ()
