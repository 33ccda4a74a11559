"""Tests of the counts of lane lines and vehicles past an intersection, from a Mobileye bus."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.detectors.cues.far_side import (
    state_at,
    vehicles_past,
)
from crosscue.replay.base import Selection
from crosscue.replay.columns import Block, Floats, Topic
from crosscue.replay.errors import VehicleError
from crosscue.replay.ledger import Ledger
from crosscue.replay.signals.extractor import SampleExtractor
from crosscue.replay.signals.kinds import MOBILEYE_SIGNALS, Samples, Signal
from crosscue.replay.signals.plan import plan
from crosscue.replay.signals.windows import windows
from crosscue.replay.vehicle.mobileye_cues import Past
from crosscue.replay.vehicle.vehicle import Vehicle, parse
from support.memory_log import MemoryLog
from support.mobileye_frames import random_drive
from support.mobileye_ros import TOPIC_TYPES, messages_of

PAST = Past()
S = 1_000_000_000
NAN = float("nan")


def obstacle(x_m: float, y_m: float, kind: int = 0, age: int = 9, burst: int = 0) -> list[float]:
    return [burst, x_m, y_m, 0.0, kind, 3, 2, age]


rows = st.lists(
    st.builds(obstacle, st.floats(0, 120), st.floats(-15, 15), st.integers(0, 4)), max_size=8
)


@given(found=rows, near=st.floats(1, 90), further=st.floats(0, 40))
def test_vehicles_past_decrease_with_range_and_are_symmetric(
    found: list[list[float]], near: float, further: float
) -> None:
    one = np.array(found).reshape(-1, 8)
    mirrored = one * np.array([1, 1, -1, 1, 1, 1, 1, 1])

    assert vehicles_past(one, near + further, PAST).sum() <= vehicles_past(one, near, PAST).sum()
    assert (vehicles_past(one, near, PAST) == vehicles_past(mirrored, near, PAST)).all()


def simulated_bursts(n: int, rng: np.random.Generator) -> Samples:
    """Simulate 10 bursts per second, each with a row without position and up to three vehicles."""
    t_ns, values = [], []
    for burst in range(n):
        for row in [[burst, *[NAN] * 7], *[obstacle(9.0, 1.0, burst=burst)] * rng.integers(0, 4)]:
            t_ns.append(burst * S // 10)
            values.append(row)
    return Samples(Signal.MOBILEYE_OBSTACLES, np.array(t_ns, np.int64), np.array(values))


@given(seed=st.integers(0, 999), t_ns=st.integers(0, 3 * S))
def test_state_depends_only_on_earlier_bursts(seed: int, t_ns: int) -> None:
    whole = simulated_bursts(30, np.random.default_rng(seed))
    known = whole.take(whole.t_ns <= t_ns)

    of_whole = state_at(whole, None, t_ns, PAST).obstacles
    of_known = state_at(known, None, t_ns, PAST).obstacles

    assert (of_whole is None) == (of_known is None)
    if of_whole is not None and of_known is not None:
        np.testing.assert_array_equal(of_whole, of_known)
        burst = min((t_ns - round(PAST.settles_s * S)) // (S // 10), 29)
        assert len(of_whole) == int((whole.values[:, 0] == burst).sum()) - 1


def vehicle_of(text: str) -> Vehicle:
    return parse("version = 1\n" + text, "test")


def samples_from(log: MemoryLog, vehicle: Vehicle) -> tuple[dict[Signal, Samples], Ledger]:
    planned = plan([(0, topic) for topic in log.topics], vehicle)
    ledger = Ledger("log")
    extractor = SampleExtractor(planned, vehicle, 0, ledger)
    asked = Selection(topics=planned.topics_of(0))
    parts: dict[Signal, list[Samples]] = {signal: [] for signal in MOBILEYE_SIGNALS}
    for window in windows([log], [extractor], [asked], planned):
        for signal, samples in window.samples.items():
            parts[signal].append(samples)
    joined = {
        signal: Samples(
            signal, np.concatenate([p.t_ns for p in of]), np.concatenate([p.values for p in of])
        )
        for signal, of in parts.items()
    }
    return joined, ledger


def in_parts(drive: Block, rows_each: int) -> list[Block]:
    return [drive.take(slice(i, i + rows_each)) for i in range(0, len(drive), rows_each)]


def test_bus_samples_do_not_depend_on_block_boundaries() -> None:
    drive = random_drive(40, np.random.default_rng(5))
    topic = Topic("can1", "crosscue/CanFrames", "columns")
    vehicle = vehicle_of('[mobileye]\nbus = "can1"\nx_m = 1.9\n')

    whole, ledger = samples_from(MemoryLog((topic,), [drive]), vehicle)
    cut, _ = samples_from(MemoryLog((topic,), in_parts(drive, 7)), vehicle)

    assert ledger.is_whole
    assert set(np.unique(whole[Signal.MOBILEYE_OBSTACLES].values[:, 0])) == set(range(40))
    for signal in MOBILEYE_SIGNALS:
        one, other = sorted_rows(whole[signal]), sorted_rows(cut[signal])
        np.testing.assert_array_equal(one, other)


def sorted_rows(samples: Samples) -> Floats:
    table = np.column_stack([samples.t_ns.astype(float), samples.values])
    return table[np.lexsort(np.nan_to_num(table, nan=-1e9).T[::-1])]


def test_ros_messages_yield_the_same_obstacles_as_the_bus() -> None:
    drive = random_drive(40, np.random.default_rng(6))
    topics = tuple(Topic(name, kind, "columns") for name, kind in TOPIC_TYPES.items())
    mounting = "[mobileye]\nx_m = 1.9\n"
    of_bus, _ = samples_from(
        MemoryLog((Topic("can1", "crosscue/CanFrames", "columns"),), [drive]),
        vehicle_of(mounting + 'bus = "can1"\n'),
    )

    of_messages, _ = samples_from(MemoryLog(topics, messages_of(drive)), vehicle_of(mounting))

    one, other = (
        rows.values[np.isfinite(rows.values[:, 1])]
        for rows in (of_bus[Signal.MOBILEYE_OBSTACLES], of_messages[Signal.MOBILEYE_OBSTACLES])
    )
    assert len(one) > 50
    np.testing.assert_array_equal(np.sort(one, axis=0), np.sort(other, axis=0))


@pytest.mark.parametrize("bus", ["", 'bus = "/not/there"\n'])
def test_missing_device_is_recorded_in_the_plan(bus: str) -> None:
    planned = plan(
        [(0, Topic("gyro", "sensor_msgs/msg/Imu", "columns"))], vehicle_of(f"[mobileye]\n{bus}")
    )

    assert "mobileye.bus" in planned.missing[Signal.MOBILEYE_OBSTACLES]


def test_two_devices_are_distinguished_by_their_topic_prefix() -> None:
    topics = [
        (0, Topic(f"/{device}/obstacle_data", "mobileye_560_660_msgs/msg/ObstacleData", "cdr"))
        for device in ("front", "rear")
    ]

    with pytest.raises(VehicleError, match=r"/front/obstacle_data, /rear/obstacle_data"):
        plan(topics, vehicle_of(""))
    chosen = plan(topics, vehicle_of('[mobileye]\nbus = "/rear"\n'))

    assert [source.topic.name for source in chosen.sources] == ["/rear/obstacle_data"]
