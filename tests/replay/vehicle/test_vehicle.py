"""Vehicle files: settings, several buses, the choice of signals, and a file's draft."""

import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.base import EVERYTHING
from crosscue.replay.columns import Block, Floats, Table, Topic
from crosscue.replay.errors import VehicleError
from crosscue.replay.ledger import Ledger
from crosscue.replay.signals.extractor import SampleExtractor
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.signals.plan import plan
from crosscue.replay.vehicle.drafting.camera import CameraMounting
from crosscue.replay.vehicle.drafting.candidates import WHEELS, Candidate, SignalKind
from crosscue.replay.vehicle.drafting.choice import Choices, rank_candidates
from crosscue.replay.vehicle.drafting.observed import Bus, Observed, observe
from crosscue.replay.vehicle.drafting.series import GroundTrack, Series
from crosscue.replay.vehicle.drafting.text import _quoted, draft_text, examine
from crosscue.replay.vehicle.vehicle import Compass, Vehicle, load, parse
from support.can_layouts import frames_of
from support.memory_log import MAGNETOMETER, MemoryLog
from support.trees import written


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
BUS_NS: Final = np.arange(N, dtype=np.int64) * 50_000_000
YAW_RATE_DEGPS: Final = 12.0 * np.sin(0.4 * BUS_NS * 1e-9)


def frames(
    bus: str, arbitration_id: int, *values: np.ndarray[tuple[int], np.dtype[np.float64]]
) -> Block:
    data = np.zeros((N, 8), np.uint8)
    for place, column in enumerate(values):
        raw = np.rint(column * 100.0).astype("<i2").view(np.uint8).reshape(N, 2)
        data[:, 2 * place : 2 * place + 2] = raw
    return Block(bus, BUS_NS, frames_of(data, arbitration_id))


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
            Block("fix", BUS_NS, fix),
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


SECONDS: Final = 60
T_NS: Final = np.arange(SECONDS * 20, dtype=np.int64) * 50_000_000
T_S: Final = T_NS * 1e-9
SPEED: Final = 12.0 + 4.0 * np.sin(0.1 * T_S)
# Yaw rate on a winding road, in rad/s.
YAW_RATE: Final = 0.15 * np.sin(0.3 * T_S) + 0.02
STRAIGHT: Final = np.zeros_like(T_S)


def candidate_signal(
    kind: SignalKind, name: str, values: Floats, wheel: str = "", unit: str = ""
) -> tuple[Candidate, Series]:
    message, _, signal = name.partition(".")
    one = Candidate(message, signal, kind, unit, 1.0, wheel, message)
    return one, Series.of(name, T_NS, values)


def wheels(message: str, speed: Floats, yaw_rate: Floats) -> list[tuple[Candidate, Series]]:
    sides = {"left": -1.0, "right": 1.0}
    return [
        candidate_signal(
            SignalKind.WHEEL,
            f"{message}.{wheel}",
            speed + sides[wheel.rpartition("_")[2]] * 0.775 * yaw_rate,
            wheel,
        )
        for wheel in WHEELS
    ]


def choices_among(
    *signals: tuple[Candidate, Series], yaw_rate: Floats | None = None, with_gnss: bool = True
) -> Choices:
    """Return the choice from these signals on one bus."""
    course = np.cumsum(YAW_RATE if yaw_rate is None else yaw_rate) * 0.05
    each_second = slice(None, None, 20)
    track = GroundTrack.of_course("fix", T_NS[each_second], SPEED[each_second], course[each_second])
    bus = Bus("can0", signals=list(signals))
    last_ns = int(T_NS[-1])
    return rank_candidates(Observed((bus,), (track,) if with_gnss else (), (), (), 0, last_ns))


@pytest.mark.parametrize("with_gnss", [True, False])
def test_yaw_rate_consistent_with_wheels_is_chosen(with_gnss: bool) -> None:
    rng = np.random.default_rng(1)
    found = choices_among(
        *wheels("ABS", SPEED, YAW_RATE),
        candidate_signal(SignalKind.YAW_RATE, "A.YAW", 0.15 * rng.standard_normal(len(T_S))),
        candidate_signal(SignalKind.YAW_RATE, "B.YAW", YAW_RATE + 0.002),
        with_gnss=with_gnss,
    )

    best, other = found.yaw_rates
    assert best.name == "B.YAW"
    assert not best.verdict.wrong
    assert best.verdict.agrees_with >= 1
    assert "does not follow" in other.verdict.wrong[0]


def test_yaw_rate_that_turns_on_straight_road_is_rejected() -> None:
    found = choices_among(
        *wheels("ABS", SPEED, STRAIGHT),
        candidate_signal(SignalKind.YAW_RATE, "A.YAW", STRAIGHT + 0.05 + 1e-6 * T_S),
        yaw_rate=STRAIGHT,
    )

    (only,) = found.yaw_rates
    assert re.match(
        r"turns 16\d deg in all where the course of fix turns 0 deg", only.verdict.wrong[0]
    )
    assert not found.is_chosen(only)


def test_yaw_rate_that_turns_while_stationary_is_rejected() -> None:
    stop = np.where(T_S > 50.0, 0.0, SPEED)
    turn = np.where(T_S > 50.0, 0.0, YAW_RATE)
    found = choices_among(
        *wheels("ABS", stop, turn),
        candidate_signal(SignalKind.YAW_RATE, "A.YAW", turn + np.where(T_S > 50.0, 0.1, 0.0)),
        with_gnss=False,
    )

    assert "turns while the car is stationary" in found.yaw_rates[0].verdict.wrong


@pytest.mark.parametrize("sign", [1, -1])
def test_sign_of_signal_is_the_consistent_one(sign: int) -> None:
    steering = np.arctan(2.7 * YAW_RATE / SPEED) * 15.0
    found = choices_among(
        *wheels("ABS", SPEED, YAW_RATE),
        candidate_signal(SignalKind.YAW_RATE, "A.YAW", sign * YAW_RATE),
        candidate_signal(SignalKind.STEERING, "A.ANGLE", sign * steering + 0.05),
    )

    assert found.yaw_rates[0].verdict.sign == sign
    assert found.steering[0].verdict.sign == sign
    assert not found.steering[0].verdict.wrong


def test_wheel_radius_is_estimated_from_angular_speeds() -> None:
    turning = [
        (replace(one, unit="rad/s"), replace(series, values=series.values / 0.31))
        for one, series in wheels("ABS", SPEED, YAW_RATE)
    ]
    (best,) = choices_among(*turning).wheels

    assert best.radius_m == pytest.approx(0.31, rel=0.01)
    assert not best.verdict.wrong


def test_mobileye_is_recognised_by_message_lengths() -> None:
    lengths = {0x738: 7} | dict.fromkeys((0x739, 0x73A, 0x73B, 0x700, 0x669, 0x737), 8)

    def recognised(ids: dict[int, int], is_extended: bool = False) -> tuple[str, ...]:
        return Bus("can1", ids={(key, is_extended): {of} for key, of in ids.items()}).mobileye

    assert "status" in recognised(lengths)
    assert not recognised(dict.fromkeys(lengths, 4))
    assert not recognised(lengths, is_extended=True)
    assert not recognised({0x738: 7})


def test_signs_are_undetermined_without_wheels_and_gnss() -> None:
    bend = 0.02 * np.sin(0.3 * T_S)
    steering = np.arctan(2.7 * bend / SPEED) * 15.0
    found = choices_among(
        candidate_signal(SignalKind.SPEED, "A.SPEED", SPEED),
        candidate_signal(SignalKind.YAW_RATE, "A.YAW", -bend),
        candidate_signal(SignalKind.STEERING, "A.ANGLE", -steering),
        with_gnss=False,
    )

    assert found.yaw_rates[0].verdict.agrees_with == 0
    assert found.steering[0].verdict.agrees_with == 0


@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_quoted_name_round_trips_and_is_printable(name: str) -> None:
    text = _quoted(name)

    assert tomllib.loads(f"name = {text}") == {"name": name}
    assert text.isprintable()


def speed_log(**columns_of: str) -> MemoryLog:
    """A log with a GNSS and one table per topic, whose column has the speed of a car that stops."""
    t_ns = np.arange(0, 60 * 10**9, 10**8)
    speed_mps = 12.0 + 8.0 * np.sin(t_ns * 2e-10)
    fixes = {"speed_mps": speed_mps, "course_rad": np.zeros(len(t_ns))}
    blocks = [Block("gnss", t_ns, Table({**fixes, "latitude_deg": np.full(len(t_ns), 52.0)}))]
    topics = [Topic("gnss", "sensor_msgs/msg/NavSatFix", "columns")]
    for name, column in columns_of.items():
        topics.append(Topic(name, "crosscue/Table", "columns"))
        scale = 3.6 if name == "in_kmph" else 1.0
        columns = {column: scale * speed_mps}
        if name == "position":
            columns["latitude_deg"] = np.full(len(t_ns), 52.0)
        blocks.append(Block(name, t_ns, Table(columns)))
    return MemoryLog(tuple(topics), blocks)


def drafted(log: MemoryLog) -> tuple[str, dict[str, str]]:
    text = draft_text(examine([log], ()), Path(), CameraMounting())
    return text, tomllib.loads(text).get("topics", {})


def test_table_with_the_speed_of_the_car_becomes_the_odometry() -> None:
    """A table of GNSS and one of another column are not the car's speed."""
    text, topics = drafted(
        speed_log(position="speed_mps", radar="relative_speed_mps", car="speed_mps")
    )

    assert topics["odometry"] == "car"
    assert "# The vehicle speed, of no axle: 10 Hz, 4.0 to 20.0 m/s" in text
    assert "# or:" not in text
    text, topics = drafted(speed_log(b="speed_mps", a="speed_x_mps"))
    assert topics["odometry"] == "a"
    assert 'odometry = "a"  # or: b' in text
