"""The choice of signals and the draft of a vehicle file."""

import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.columns import Block, Floats, Table, Topic
from crosscue.replay.vehicle.drafting.camera import CameraMounting
from crosscue.replay.vehicle.drafting.candidates import WHEELS, Candidate, SignalKind
from crosscue.replay.vehicle.drafting.choice import Choices, rank_candidates
from crosscue.replay.vehicle.drafting.observed import Bus, Observed
from crosscue.replay.vehicle.drafting.series import GroundTrack, Series
from crosscue.replay.vehicle.drafting.text import _quoted, draft_text, examine
from support.memory_log import MemoryLog

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


def wheels(
    message: str, speed: Floats, yaw_rate: Floats, scale: float = 1.0
) -> list[tuple[Candidate, Series]]:
    sides = {"left": -1.0, "right": 1.0}
    return [
        candidate_signal(
            SignalKind.WHEEL,
            f"{message}.{wheel}",
            scale * (speed + sides[wheel.rpartition("_")[2]] * 0.775 * yaw_rate),
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
