"""ROS messages and CAN frames of a Mobileye decode to the same columns."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.columns import Block, CanFrames, Table
from crosscue.replay.ledger import Ledger
from crosscue.replay.mobileye.can.decode import MobileyeDecoder
from crosscue.replay.mobileye.geometry import DevicePosition
from crosscue.replay.mobileye.layout import layout
from crosscue.replay.mobileye.ros.reader import VOTES_WANTED, RosMobileye
from crosscue.replay.mobileye.settings import MobileyeSettings
from support.can_layouts import join
from support.mobileye_frames import (
    MS,
    frames,
    random_drive,
    random_words,
    status,
    tables_of,
    triple,
    values,
)
from support.mobileye_ros import TOPIC_TYPES, messages_of

BUS_SETTINGS = MobileyeSettings(
    mounting=DevicePosition(1.9, 0.1), family="extended", ros_lane_sign="right"
)


def tables_from_can(block: Block, how: MobileyeSettings = BUS_SETTINGS) -> dict[str, Table]:
    decoder = MobileyeDecoder("can1", Ledger("log"), how)
    return tables_of([*decoder(block), *decoder.flush()])


def tables_from_bag(
    blocks: Sequence[Block], how: MobileyeSettings = BUS_SETTINGS
) -> tuple[dict[str, Table], Ledger]:
    ledger = Ledger("log")
    reader = RosMobileye("ros", TOPIC_TYPES, ledger, how)
    tables = [table for block in blocks for table in reader(block)]
    return tables_of([*tables, *reader.flush()]), ledger


def sorted_by_time(table: Table) -> Table:
    keys = [table[n] for n in ("slot", "index", "side", "t_ns") if n in table.columns]
    return table.take(np.lexsort(keys))


@pytest.mark.slow
@given(seed=st.integers(0, 10_000))
@settings(max_examples=15)
def test_messages_decode_to_same_columns_as_frames(seed: int) -> None:
    drive = random_drive(6, np.random.default_rng(seed))
    can = tables_from_can(drive)
    bag, ledger = tables_from_bag(messages_of(drive))

    assert can.keys() == bag.keys()
    for name, table in can.items():
        assert list(table.columns) == list(bag[name].columns)
        if name == "next_lanes":
            continue  # a message does not identify its lane
        from_frames, from_messages = sorted_by_time(table), sorted_by_time(bag[name])
        for column in table.columns:
            assert from_frames[column].dtype == from_messages[column].dtype, column
            if name != "lanes" or column != "burst":
                np.testing.assert_array_equal(
                    from_frames[column], from_messages[column], err_msg=column
                )
    assert ledger.is_whole
    assert not any(account.skipped for account in ledger.accounts.values())


@pytest.mark.parametrize(
    ("name", "variant"),
    [
        ("lane_details", "classic"),
        ("aftermarket_lane", ""),
        ("warnings", "extended"),
        ("sign", "basic"),
    ],
)
def test_standalone_messages_decode_to_same_columns_as_frames(name: str, variant: str) -> None:
    message = layout()[name]
    words = random_words(message, 30, np.random.default_rng(4), variant)
    payloads = [(message.ids[0], int(w).to_bytes(8, "little").hex()) for w in words.tolist()]
    sent = frames(payloads, range(MS, 31 * MS, MS))
    how = replace(BUS_SETTINGS, revision="classic")
    can, (bag, _) = tables_from_can(sent, how), tables_from_bag(messages_of(sent), how)

    for column in can[message.table].columns:
        if column != "sign":
            np.testing.assert_array_equal(can[message.table][column], bag[message.table][column])


@pytest.mark.slow
@given(seed=st.integers(0, 10_000), cut=st.integers(0, 60), order=st.permutations(range(5)))
@settings(max_examples=20)
def test_tables_do_not_depend_on_topic_interleaving(seed: int, cut: int, order: list[int]) -> None:
    """A reader may yield a block of one topic long before the others."""
    messages = messages_of(random_drive(12, np.random.default_rng(seed)))
    pieces = [piece for m in messages for piece in (m.take(np.s_[:cut]), m.take(np.s_[cut:]))]
    firsts, seconds = pieces[0::2], pieces[1::2]
    mixed = [firsts[k] for k in order if k < len(firsts)]
    mixed += [seconds[k] for k in order[::-1] if k < len(seconds)]
    straight, _ = tables_from_bag(messages)
    shuffled, ledger = tables_from_bag(mixed)

    for name, table in straight.items():
        from_frames, from_messages = sorted_by_time(table), sorted_by_time(shuffled[name])
        for column in table.columns:
            np.testing.assert_array_equal(
                from_frames[column], from_messages[column], err_msg=f"{name} {column}"
            )
    assert ledger.is_whole


def obstacle_drive() -> list[Block]:
    sent = [f for k in range(4) for f in (status(2, 66 * k), *triple(0, k), *triple(1, k + 9))]
    times = [1000 * MS + 66 * MS * (k // 7) + k % 7 * MS for k in range(28)]
    return messages_of(frames(sent, times))


def lane_drive(seconds: int, mirrored: bool) -> list[Block]:
    """Return a left lane at 1.75 m and a right lane at -1.25 m, with bus signs or mirrored."""
    left, right = ("40FE", "4001") if not mirrored else ("C001", "C0FE")
    burst = [
        (0x766, f"A1{left}FF7FFF7F0A"),
        (0x767, "FF7F801E"),
        (0x768, f"A1{right}FF7FFF7F0A"),
        (0x769, "FF7F801E"),
    ]
    n = 15 * seconds
    times = [k * 66 * MS + j * MS for k in range(n) for j in range(4)]
    return messages_of(frames(burst * n, [10**18 + t for t in times]))


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("seconds", [1, 10])
def test_lane_sign_is_inferred_from_messages(mirrored: bool, seconds: int) -> None:
    assert 4 * VOTES_WANTED > 15 * 4  # one second has too few votes, so the end of the log decides
    how = replace(BUS_SETTINGS, ros_lane_sign="auto")
    bag, ledger = tables_from_bag(lane_drive(seconds, mirrored), how)

    lanes = bag["lanes"]
    assert (values(lanes, "c0_m") * values(lanes, "side") > 0).all()
    assert len(lanes) == 2 * 15 * seconds
    assert any("positive to the left" in n for n in ledger.notices) == mirrored


def test_unused_messages_are_skipped_by_topic_and_reason() -> None:
    statuses, obstacles = obstacle_drive()
    assert isinstance(obstacles.rows, Table)
    fewer = {n: c for n, c in obstacles.rows.columns.items() if n != "obstacle_pos_x"}
    foe = Block("/parsed_tx/fixed_foe", np.zeros(2, dtype=np.int64), Table({"a": np.zeros(2)}))
    raw = replace(frames([status(0, 0)]), topic="/parsed_tx/lane")
    assert isinstance(raw.rows, CanFrames)
    _, ledger = tables_from_bag([statuses, replace(obstacles, rows=Table(fewer)), foe, raw])

    reasons = {topic: dict(a.skipped) for topic, a in ledger.accounts.items() if a.skipped}
    assert reasons == {
        "/parsed_tx/obstacle_data": {"message lacks fields of its type": 8},
        "/parsed_tx/fixed_foe": {"message without a known counterpart on CAN": 2},
        "/parsed_tx/lane": {"message was not decoded to columns": 1},
    }
    assert ledger.details[0].detail == "obstacle_pos_x"


def test_obstacles_without_status_keep_their_own_time() -> None:
    statuses, obstacles = obstacle_drive()
    bag, ledger = tables_from_bag([statuses.take(np.arange(4) != 2), obstacles])

    assert bag["obstacles"]["burst"].tolist() == [0, 0, 1, 1, -1, -1, 2, 2]
    assert bag["obstacles"]["slot"].tolist() == [0, 1, 0, 1, -1, -1, 0, 1]
    assert any("keep their own time" in n for n in ledger.notices)


def test_topics_of_other_types_are_ignored() -> None:
    reader = RosMobileye("ros", {"/imu": "sensor_msgs/msg/Imu"}, Ledger("log"), BUS_SETTINGS)
    assert reader(join([replace(frames([status(0, 0)]), topic="/imu")])) == []
