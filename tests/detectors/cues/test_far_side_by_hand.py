"""Counts and cues past the intersection from a Mobileye: every condition at its limit."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.detectors.cues.far_side import (
    MobileyeState,
    end_of,
    lanes_past,
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
from support.mobileye_frames import TOPIC_TYPES, messages_of, random_drive

MS = 1_000_000
NAN = float("nan")
PAST = Past(
    intersection_length_m=16.0,
    lane_reach_m=5.0,
    lane_within_y_m=8.0,
    lane_quality=2.0,
    lane_types=(0, 4),
    vehicle_beyond_m=3.0,
    vehicle_within_y_m=6.0,
    vehicle_types=(0, 2),
    vehicle_age_frames=2.0,
    max_age_s=0.5,
    settles_s=0.03,
)
END_M = 20.0


def obstacle(**changes: float) -> list[float]:
    """A vehicle that counts: 23 m ahead = 20 m + 3 m, 6 m aside, of type 2, found in 2 images."""
    row = {"burst": 1.0, "x_m": 23.0, "y_m": 6.0, "vx_mps": 0.0, "type": 2.0, "status": 0.0}
    return list((row | {"valid": 1.0, "age_frames": 2.0} | changes).values())


def lane(**changes: float) -> list[float]:
    """A line that counts: it reaches 25 m = 20 m + 5 m, and its quality is 2.

    At 25 m it is 0.5 + 0.1 * 25 + 0.004 * 625 + 0.00016 * 15,625 = 0.5 + 3 * 2.5 = 8 m aside.
    """
    row = {"side": 1.0, "lane_type": 4.0, "quality": 2.0, "c0_m": 0.5, "c1": 0.1}
    rest = {"c2_per_m": 0.004, "c3_per_m2": 0.00016, "x_end_m": 25.0}
    return list((row | rest | changes).values())


@pytest.mark.parametrize(
    ("changes", "counts"),
    [
        ({}, True),
        ({"x_m": 22.99}, False),
        ({"y_m": -6.0}, True),
        ({"y_m": 6.01}, False),
        ({"y_m": -6.01}, False),
        ({"type": 0.0}, True),
        ({"type": 1.0}, False),
        ({"valid": 0.0}, False),
        ({"valid": 2.0}, True),
        ({"age_frames": 1.0}, False),
    ],
)
def test_vehicle_past_is_counted_at_each_limit(changes: dict[str, float], counts: bool) -> None:
    """At least 3 m past 20 m, at most 6 m aside, valid, of a type of vehicles, and in 2 images."""
    assert vehicles_past(np.array([obstacle(**changes)]), END_M, PAST).tolist() == [counts]
    state = MobileyeState(np.array([obstacle(**changes), obstacle()]), None)
    assert past_counts(state, END_M, PAST) == {"vehicles_past": 1 + counts}


@pytest.mark.parametrize(
    ("changes", "counts"),
    [
        ({"c0_m": 0.49}, True),
        ({"c0_m": 0.51}, False),  # 8.01 m aside
        ({"c0_m": 8.0, "c1": 0.0, "c2_per_m": 0.0, "c3_per_m2": 0.0}, True),
        ({"c0_m": -15.49}, True),  # -7.99 m aside
        ({"c0_m": -15.51}, False),
        ({"c0_m": 0.49, "x_end_m": 24.99}, False),
        ({"c0_m": 0.49, "quality": 1.0}, False),
        ({"c0_m": 0.49, "quality": 3.0}, True),
        ({"c0_m": 0.49, "lane_type": 1.0}, False),
        ({"c0_m": 0.49, "lane_type": 0.0}, True),
        ({"c0_m": NAN, "x_end_m": NAN}, False),
    ],
)
def test_lane_line_past_is_counted_at_each_limit(changes: dict[str, float], counts: bool) -> None:
    """It reaches 5 m past 20 m, is at most 8 m aside there, and is usable."""
    assert lanes_past(np.array([lane(**changes)]), END_M, PAST).tolist() == [counts]
    state = MobileyeState(None, np.array([lane(**changes), lane(quality=0.0)]))
    assert past_counts(state, END_M, PAST) == {"lanes_past": int(counts)}


def test_one_of_two_lane_lines_past_is_one_count() -> None:
    lanes = np.array([lane(c0_m=0.0), lane(c0_m=0.1), lane(quality=0.0)])

    assert past_counts(MobileyeState(None, lanes), END_M, PAST) == {"lanes_past": 1}


@pytest.mark.parametrize(
    ("end_m", "known"), [(None, False), (-1.0, False), (0.0, False), (0.5, True), (1.0, True)]
)
def test_counts_are_known_ahead_of_the_intersections_end(end_m: float | None, known: bool) -> None:
    assert bool(past_counts(MobileyeState(np.array([obstacle()]), None), end_m, PAST)) == known


def test_device_without_data_has_no_counts_and_one_that_found_nothing_has_zeros() -> None:
    nothing = np.empty((0, 8))

    assert past_counts(MobileyeState(None, None), END_M, PAST) == {}
    counts = past_counts(MobileyeState(nothing, nothing), END_M, PAST)
    assert counts == {"vehicles_past": 0, "lanes_past": 0}


def test_end_is_the_start_plus_sixteen_metres() -> None:
    assert end_of(30.0, is_end=False, past=PAST) == 46.0
    assert end_of(30.0, is_end=True, past=PAST) == 30.0


def samples(signal: Signal, *rows: tuple[int, Sequence[float]]) -> Samples:
    times = np.array([ms * MS for ms, _ in rows], np.int64)
    return Samples(signal, times, np.array([row for _, row in rows], np.float64))


@pytest.mark.parametrize(
    ("ms", "is_known"), [(1029, False), (1030, True), (1500, True), (1501, False)]
)
def test_state_is_of_bursts_that_are_complete_and_recent(ms: int, is_known: bool) -> None:
    """A burst at 1,000 ms is complete after 30 ms and too old after 500 ms."""
    obstacles = samples(Signal.MOBILEYE_OBSTACLES, (1000, obstacle()))
    lanes = samples(Signal.MOBILEYE_LANES, (1000, lane()))

    state = state_at(obstacles, lanes, ms * MS, PAST)

    assert (state.obstacles is not None) == (state.lanes is not None) == is_known
    nothing = state_at(None, None, ms * MS, PAST)
    assert nothing.obstacles is None
    assert nothing.lanes is None


@pytest.mark.parametrize(
    ("late_ns", "x_m"),
    [
        (100_000 * MS - 1, [23.0]),
        (100_000 * MS, [40.0]),
        (200_000 * MS, [40.0]),
        (200_000 * MS + 1, None),
    ],
)
def test_limits_of_a_bursts_age_are_exact_to_the_nanosecond(
    late_ns: int, x_m: list[float] | None
) -> None:
    """Bursts at 1 and 101 s are complete after 100 s and recent for 200 s.

    The row 100 s before the last is not of its image.
    """
    slow = PAST.model_copy(update={"settles_s": 100.0, "max_age_s": 200.0})
    obstacles = samples(
        Signal.MOBILEYE_OBSTACLES,
        (1000, obstacle(burst=-1.0)),
        (101_000, obstacle(burst=-1.0, x_m=40.0)),
    )

    found = state_at(obstacles, None, 101_000 * MS + late_ns, slow).obstacles

    assert (None if found is None else found[:, 1].tolist()) == x_m


def test_state_has_the_rows_of_the_last_burst_with_a_position() -> None:
    """Burst 2 has rows at 40, 50 and 60 m, and a row without a position that starts it."""
    rows = samples(
        Signal.MOBILEYE_OBSTACLES,
        (1000, obstacle(burst=1.0, x_m=10.0)),
        (1040, [2.0, *[NAN] * 7]),
        (1040, obstacle(burst=2.0, x_m=40.0)),
        (1100, obstacle(burst=2.0, x_m=50.0)),
        (1100, obstacle(burst=2.0, x_m=60.0)),
        (1200, obstacle(burst=3.0, x_m=70.0)),
    )

    found = state_at(rows, None, 1140 * MS, PAST).obstacles

    assert found is not None
    assert found[:, 1].tolist() == [40.0, 50.0, 60.0]


def test_rows_without_a_burst_belong_together_within_the_settling_time() -> None:
    """The last row is at 1,100 ms, so those after 1,070 ms are of its image. 0 is a number."""
    rows = samples(
        Signal.MOBILEYE_OBSTACLES,
        (1000, obstacle(burst=-1.0, x_m=10.0)),
        (1070, obstacle(burst=-1.0, x_m=20.0)),
        (1071, obstacle(burst=-1.0, x_m=30.0)),
        (1100, obstacle(burst=-1.0, x_m=40.0)),
    )
    numbered = samples(
        Signal.MOBILEYE_OBSTACLES,
        (1000, obstacle(burst=0.0, x_m=10.0)),
        (1100, obstacle(burst=0.0, x_m=40.0)),
    )

    for one, expected in ((rows, [30.0, 40.0]), (numbered, [10.0, 40.0])):
        found = state_at(one, None, 1200 * MS, PAST).obstacles
        assert found is not None
        assert found[:, 1].tolist() == expected


def test_state_has_the_last_lane_line_of_each_side() -> None:
    rows = samples(
        Signal.MOBILEYE_LANES,
        (1000, lane(side=1.0, c0_m=1.0)),
        (1010, lane(side=0.0, c0_m=2.0)),
        (1020, lane(side=1.0, c0_m=3.0)),
        (1200, lane(side=0.0, c0_m=4.0)),
    )

    found = state_at(None, rows, 1100 * MS, PAST).lanes

    assert found is not None
    assert found[:, [0, 3]].tolist() == [[0.0, 2.0], [1.0, 3.0]]


USUAL = Past()
S = 1_000_000_000


def simulated_bursts(n: int, rng: np.random.Generator) -> Samples:
    """Simulate 10 bursts per second, each with a row without position and up to three vehicles."""
    t_ns, values = [], []
    for burst in range(n):
        seen = [burst, 9.0, 1.0, 0.0, 0.0, 3.0, 2.0, 9.0]
        for row in [[burst, *[NAN] * 7], *[seen] * rng.integers(0, 4)]:
            t_ns.append(burst * S // 10)
            values.append(row)
    return Samples(Signal.MOBILEYE_OBSTACLES, np.array(t_ns, np.int64), np.array(values))


@given(seed=st.integers(0, 999), t_ns=st.integers(0, 3 * S))
def test_state_depends_only_on_earlier_bursts(seed: int, t_ns: int) -> None:
    whole = simulated_bursts(30, np.random.default_rng(seed))
    known = whole.take(whole.t_ns <= t_ns)

    of_whole = state_at(whole, None, t_ns, USUAL).obstacles
    of_known = state_at(known, None, t_ns, USUAL).obstacles

    assert (of_whole is None) == (of_known is None)
    if of_whole is not None and of_known is not None:
        np.testing.assert_array_equal(of_whole, of_known)
        burst = min((t_ns - round(USUAL.settles_s * S)) // (S // 10), 29)
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
