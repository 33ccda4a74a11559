"""Counts of lane lines and vehicles past an intersection, from a Mobileye's bus."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.datasets.scenes.drive import write_scene
from crosscue.datasets.scenes.rendering.camera import Camera
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.datasets.truth.truth import load as load_truth
from crosscue.detectors.cues.far_side import (
    MobileyeState,
    end_of,
    past_counts,
    state_at,
    vehicles_past,
)
from crosscue.replay.base import Block, Floats, Ledger, Selection, Topic, VehicleError
from crosscue.replay.logs.opening import open_log
from crosscue.replay.signals.extractor import Extractor
from crosscue.replay.signals.kinds import MOBILEYE_SIGNALS, Samples, Signal
from crosscue.replay.signals.plan import plan
from crosscue.replay.signals.windows import Window, windows
from crosscue.replay.vehicle.mobileye_cues import Past
from crosscue.replay.vehicle.vehicle import Vehicle, load, parse
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
        (obstacle(40.0, -9.0), 0),  # in a lot beside the road
        (obstacle(40.0, 9.0), 0),
        (obstacle(40.0, 0.0, kind=3), 0),  # a pedestrian
        (obstacle(40.0, 0.0, age=1), 0),  # seen for the first time
    ],
)
def test_a_vehicle_counts_past_the_end_and_on_the_road(row: list[float], count: int) -> None:
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
def test_a_line_counts_when_it_reaches_past_the_end(row: list[float], count: int) -> None:
    assert past_counts(state(lanes=[row]), 20.0, PAST) == {"lanes_past": count}


@pytest.mark.parametrize("end_m", [None, 0.0, -3.0])
def test_without_a_range_nothing_is_said(end_m: float | None) -> None:
    assert past_counts(state([obstacle(40.0, 0.0)], [lane(60.0)]), end_m, PAST) == {}


def test_a_device_that_says_nothing_is_neutral_and_one_that_sees_nothing_is_not() -> None:
    assert past_counts(state(), 20.0, PAST) == {}
    assert past_counts(state([], []), 20.0, PAST) == {"vehicles_past": 0, "lanes_past": 0}


def test_a_start_stands_for_an_end_by_the_intersections_length() -> None:
    assert end_of(30.0, is_end=True, past=PAST) == 30.0
    assert end_of(30.0, is_end=False, past=Past(intersection_length_m=12.0)) == 42.0


rows = st.lists(
    st.builds(obstacle, st.floats(0, 120), st.floats(-15, 15), st.integers(0, 4)), max_size=8
)


@given(found=rows, near=st.floats(1, 90), further=st.floats(0, 40))
@settings(max_examples=60, deadline=None)
def test_a_further_end_never_has_more_vehicles_past_it_and_sides_are_alike(
    found: list[list[float]], near: float, further: float
) -> None:
    one = np.array(found).reshape(-1, 8)
    mirrored = one * np.array([1, 1, -1, 1, 1, 1, 1, 1])

    assert vehicles_past(one, near + further, PAST).sum() <= vehicles_past(one, near, PAST).sum()
    assert (vehicles_past(one, near, PAST) == vehicles_past(mirrored, near, PAST)).all()


def said(n: int, rng: np.random.Generator) -> Samples:
    """Ten bursts per second, each with a row without a position and up to three vehicles."""
    t_ns, values = [], []
    for burst in range(n):
        for row in [[burst, *[NAN] * 7], *[obstacle(9.0, 1.0, burst=burst)] * rng.integers(0, 4)]:
            t_ns.append(burst * S // 10)
            values.append(row)
    return Samples(Signal.MOBILEYE_OBSTACLES, np.array(t_ns, np.int64), np.array(values))


@given(seed=st.integers(0, 999), t_ns=st.integers(0, 3 * S))
@settings(max_examples=60, deadline=None)
def test_what_comes_later_changes_nothing(seed: int, t_ns: int) -> None:
    whole = said(30, np.random.default_rng(seed))
    known = whole.take(whole.t_ns <= t_ns)

    of_whole = state_at(whole, None, t_ns, PAST).obstacles
    of_known = state_at(known, None, t_ns, PAST).obstacles

    assert (of_whole is None) == (of_known is None)
    if of_whole is not None and of_known is not None:
        np.testing.assert_array_equal(of_whole, of_known)
        burst = min((t_ns - round(PAST.settles_s * S)) // (S // 10), 29)
        assert len(of_whole) == int((whole.values[:, 0] == burst).sum()) - 1


@pytest.mark.parametrize("late_s", [0.55, 5.0])
def test_a_device_that_fell_silent_is_forgotten(late_s: float) -> None:
    whole = said(3, np.random.default_rng(1))

    assert state_at(whole, None, round((0.2 + late_s) * S), PAST).obstacles is None


def test_a_burst_that_is_not_whole_yet_is_not_looked_at() -> None:
    whole = said(2, np.random.default_rng(3))

    early = state_at(whole, None, S // 10 + 20_000_000, PAST).obstacles

    assert early is not None
    assert len(early) == int((whole.values[:, 0] == 0).sum()) - 1


def vehicle_of(text: str) -> Vehicle:
    return parse("version = 1\n" + text, "test")


def samples_from(log: MemoryLog, vehicle: Vehicle) -> tuple[dict[Signal, Samples], Ledger]:
    planned = plan([(0, topic) for topic in log.topics], vehicle)
    ledger = Ledger("log")
    extractor = Extractor(planned, vehicle, 0, ledger)
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


def in_bits(drive: Block, rows_each: int) -> list[Block]:
    return [drive.take(slice(i, i + rows_each)) for i in range(0, len(drive), rows_each)]


def test_the_bus_gives_the_same_samples_however_it_is_cut_and_the_last_burst_too() -> None:
    drive = random_drive(40, np.random.default_rng(5))
    topic = Topic("can1", "crosscue/CanFrames", "columns")
    vehicle = vehicle_of('[mobileye]\nbus = "can1"\nx_m = 1.9\n')

    whole, ledger = samples_from(MemoryLog((topic,), [drive]), vehicle)
    cut, _ = samples_from(MemoryLog((topic,), in_bits(drive, 7)), vehicle)

    assert ledger.is_whole
    assert set(np.unique(whole[Signal.MOBILEYE_OBSTACLES].values[:, 0])) == set(range(40))
    for signal in MOBILEYE_SIGNALS:
        one, other = as_set(whole[signal]), as_set(cut[signal])
        np.testing.assert_array_equal(one, other)


def as_set(samples: Samples) -> Floats:
    table = np.column_stack([samples.t_ns.astype(float), samples.values])
    return table[np.lexsort(np.nan_to_num(table, nan=-1e9).T[::-1])]


def test_messages_give_the_same_obstacles_as_the_bus() -> None:
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
def test_a_log_without_a_device_is_no_error(bus: str) -> None:
    planned = plan(
        [(0, Topic("gyro", "sensor_msgs/msg/Imu", "columns"))], vehicle_of(f"[mobileye]\n{bus}")
    )

    assert "mobileye.bus" in planned.missing[Signal.MOBILEYE_OBSTACLES]


def test_two_devices_are_told_apart_by_how_their_topics_begin() -> None:
    topics = [
        (0, Topic(f"/{device}/obstacle_data", "mobileye_560_660_msgs/msg/ObstacleData", "cdr"))
        for device in ("front", "rear")
    ]

    with pytest.raises(VehicleError, match=r"/front/obstacle_data, /rear/obstacle_data"):
        plan(topics, vehicle_of(""))
    chosen = plan(topics, vehicle_of('[mobileye]\nbus = "/rear"\n'))

    assert [source.topic.name for source in chosen.sources] == ["/rear/obstacle_data"]


def windows_of(folder: Path, vehicle: Vehicle) -> list[Window]:
    with open_log(folder / "drive.mcap") as log:
        planned = plan([(0, topic) for topic in log.topics], vehicle)
        extractor = Extractor(planned, vehicle, 0, Ledger("drive"))
        return list(windows([log], [extractor], [Selection(planned.topics_of(0))], planned))


@pytest.mark.slow
def test_on_a_simulated_drive_lines_and_vehicles_past_it_are_counted(tmp_path: Path) -> None:
    """L303 has a road ahead with cars on it; both cues are positive before the intersection."""
    tiny = SceneSettings(layout="L303", camera=replace(Camera(), width_px=192, height_px=108))
    files = write_scene(tmp_path, tiny)
    ranges = np.loadtxt(tmp_path / "ranges.csv", delimiter=",", skiprows=1)
    truth = load_truth(files.truth)
    there = [c for c in truth.cues if c.cue == "road_straight" and c.present]
    given: dict[str, list[int]] = {"lanes_past": [], "vehicles_past": []}
    seen = [window.samples for window in windows_of(tmp_path, load(files.vehicle))]
    obstacles, lanes = (
        Samples(
            signal,
            np.concatenate([part[signal].t_ns for part in seen if signal in part]),
            np.concatenate([part[signal].values for part in seen if signal in part]),
        )
        for signal in (Signal.MOBILEYE_OBSTACLES, Signal.MOBILEYE_LANES)
    )
    for t_ns, _, _, end_m in ranges[ranges[:, 2] > 0].tolist():
        state = state_at(obstacles, lanes, int(t_ns), PAST)
        for cue, count in past_counts(state, end_m, PAST).items():
            given[cue].append(count)

    assert there
    for counts in given.values():
        assert len(counts) > 40
        assert max(counts) > 0
    assert max(given["lanes_past"]) == 1
