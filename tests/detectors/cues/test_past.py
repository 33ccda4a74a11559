"""Tests of the counts of lane lines and vehicles past an intersection, from a Mobileye bus."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.detectors.cues.far_side import (
    MobileyeState,
    end_of,
    past_counts,
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


def lane(x_end_m: float, c0_m: float = 0.2, quality: int = 3, slope: float = 0.0) -> list[float]:
    return [1.0, 4, quality, c0_m, slope, 0.0, 0.0, x_end_m]


def state(
    obstacles: Sequence[list[float]] | None = None, lanes: Sequence[list[float]] | None = None
) -> MobileyeState:
    return MobileyeState(
        None if obstacles is None else np.array(obstacles, float).reshape(-1, 8),
        None if lanes is None else np.array(lanes, float).reshape(-1, 8),
    )


@pytest.mark.parametrize(
    ("row", "count"),
    [
        (obstacle(40.0, 2.0), 1),
        (obstacle(22.0, 2.0), 0),  # still within the intersection
        (obstacle(40.0, -9.0), 0),  # in a parking lot next to the road
        (obstacle(40.0, 9.0), 0),
        (obstacle(40.0, 0.0, kind=3), 0),  # a pedestrian
        (obstacle(40.0, 0.0, age=1), 0),  # seen for the first time
    ],
)
def test_vehicle_counts_past_the_intersection_and_on_the_road(row: list[float], count: int) -> None:
    assert past_counts(state([row]), 20.0, PAST) == {"vehicles_past": count}


@pytest.mark.parametrize(
    ("row", "count"),
    [
        (lane(50.0), 1),
        (lane(24.0), 0),  # ends with the intersection
        (lane(50.0, quality=1), 0),
        (lane(50.0, slope=0.6), 0),  # bends into the crossroad
        (lane(NAN, c0_m=NAN, quality=0), 0),  # no marking on this side
    ],
)
def test_lane_line_counts_if_it_extends_past_the_intersection(row: list[float], count: int) -> None:
    assert past_counts(state(lanes=[row]), 20.0, PAST) == {"lanes_past": count}


@pytest.mark.parametrize("end_m", [None, 0.0, -3.0])
def test_counts_are_missing_without_a_valid_range(end_m: float | None) -> None:
    assert past_counts(state([obstacle(40.0, 0.0)], [lane(60.0)]), end_m, PAST) == {}


def test_missing_data_yields_no_counts_and_empty_data_yields_zero() -> None:
    assert past_counts(state(), 20.0, PAST) == {}
    assert past_counts(state([], []), 20.0, PAST) == {"vehicles_past": 0, "lanes_past": 0}


def test_intersection_end_is_its_start_plus_its_length() -> None:
    assert end_of(30.0, is_end=True, past=PAST) == 30.0
    assert end_of(30.0, is_end=False, past=Past(intersection_length_m=12.0)) == 42.0


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


@pytest.mark.parametrize("late_s", [0.55, 5.0])
def test_state_is_missing_after_the_device_stops(late_s: float) -> None:
    whole = simulated_bursts(3, np.random.default_rng(1))

    assert state_at(whole, None, round((0.2 + late_s) * S), PAST).obstacles is None


def test_incomplete_burst_is_not_used() -> None:
    whole = simulated_bursts(2, np.random.default_rng(3))

    early = state_at(whole, None, S // 10 + 20_000_000, PAST).obstacles

    assert early is not None
    assert len(early) == int((whole.values[:, 0] == 0).sum()) - 1


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
