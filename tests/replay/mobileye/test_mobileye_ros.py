"""Mobileye tables: the inverse of their encoding, and from ROS messages as from CAN frames."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.columns import Block, CanFrames, Table
from crosscue.replay.ledger import Ledger
from crosscue.replay.mobileye.can.decode import MobileyeDecoder
from crosscue.replay.mobileye.can.encode import bursts_of, encode_tables
from crosscue.replay.mobileye.geometry import DevicePosition
from crosscue.replay.mobileye.layout import Columns, Message, layout
from crosscue.replay.mobileye.ros.reader import VOTES_WANTED, RosMobileye
from crosscue.replay.mobileye.settings import MobileyeSettings
from support.can_layouts import join
from support.mobileye_frames import (
    MS,
    TOPIC_TYPES,
    block_of,
    frames,
    messages_of,
    random_drive,
    random_words,
    status,
    tables_of,
    triple,
    values,
)

ROTATED = MobileyeSettings(mounting=DevicePosition(1.85, -0.1, 0.02))
UNROTATED = MobileyeSettings(mounting=DevicePosition(1.85, -0.1))


def decode(block: Block, how: MobileyeSettings) -> list[Block]:
    ledger = Ledger("log")
    decoder = MobileyeDecoder("can1", ledger, how)
    decoded = decoder(block) + decoder.flush()
    assert not ledger.topic("can1").skipped
    return decoded


def assert_same_frames(actual: Block, expected: Block) -> None:
    assert isinstance(actual.rows, CanFrames)
    assert isinstance(expected.rows, CanFrames)
    np.testing.assert_array_equal(actual.log_ns, expected.log_ns)
    for name in ("arbitration_id", "length", "data"):
        np.testing.assert_array_equal(getattr(actual.rows, name), getattr(expected.rows, name))


@pytest.mark.slow
@pytest.mark.parametrize("revision", ["classic", "2.32"])
@pytest.mark.parametrize("how", [ROTATED, UNROTATED])
@given(seed=st.integers(0, 100_000))
@settings(max_examples=12)
def test_encoding_founds_restores_frames(revision: str, how: MobileyeSettings, seed: int) -> None:
    """Lanes are included only without a mounting angle, because rotating them is not exact."""
    drive = random_drive(5, np.random.default_rng(seed), revision, has_lanes=how is UNROTATED)
    assert_same_frames(encode_tables(decode(drive, how), how, "can1"), drive)


def standalone_messages() -> list[tuple[Message, str]]:
    """Return every message that is not joined with others, in each of its variants."""
    joined = ("status", "obstacles", "lanes", "next_lanes")
    return [
        (message, variant)
        for message in layout().values()
        if message.table not in joined
        for variant in sorted(
            {f.only for f in message.fields if f.only} | set(message.variants.values())
        )
        or [""]
    ]


@pytest.mark.parametrize(
    ("message", "variant"), standalone_messages(), ids=lambda x: getattr(x, "name", x)
)
def test_standalone_messages_round_trip_byte_for_byte(message: Message, variant: str) -> None:
    n = 40
    words = random_words(message, n, np.random.default_rng(3), variant)
    ids = np.array(message.ids)[np.arange(n) % len(message.ids)]
    lengths = np.full(n, message.length_of(variant))
    sent = block_of(words, ids, lengths, np.arange(n) * MS)
    how = settings_for(variant)

    assert_same_frames(encode_tables(decode(sent, how), how, "can1"), sent)


def settings_for(variant: str) -> MobileyeSettings:
    setting = {"classic": "revision", "2.32": "revision", "extended": "family", "tsr": "family"}
    more = {setting[variant]: variant} if variant in setting else {}
    return replace(UNROTATED, **more)  # type: ignore[arg-type]


def scene(seed: int, n: int) -> tuple[Columns, list[int]]:
    """Return columns of the table ``obstacles`` within the device's range, and image times."""
    rng = np.random.default_rng(seed)
    image_ns = [10**18 + k * 66 * MS for k in range(10)]
    t_ns = np.array([image_ns[k] for k in np.sort(rng.integers(0, 10, n))], dtype=np.int64)
    return {
        "t_ns": t_ns,
        "obstacle_id": rng.integers(0, 64, n).astype(np.int16),
        "x_m": rng.uniform(3.0, 240.0, n),
        "y_m": rng.uniform(-25.0, 25.0, n),
        "vx_mps": rng.uniform(-60.0, 60.0, n),
        "type": rng.integers(0, 5, n).astype(np.int16),
        "status": rng.integers(0, 6, n).astype(np.int16),
        "length_m": np.where(rng.random(n) < 0.3, np.nan, rng.uniform(0.0, 31.0, n)),
        "width_m": rng.uniform(0.0, 12.5, n),
        "age_frames": rng.integers(1, 255, n).astype(np.int16),
        "cipv": rng.random(n) < 0.1,
        "brake_lights": rng.random(n) < 0.5,
        "accel_x_mps2": np.where(rng.random(n) < 0.3, np.nan, rng.uniform(-15.0, 15.0, n)),
        "angle_rate": rng.uniform(-300.0, 300.0, n),
        "scale_change": rng.uniform(-6.0, 6.0, n),
        "radar_x_m": np.where(rng.random(n) < 0.5, np.nan, rng.uniform(3.0, 250.0, n)),
        "radar_vx_mps": rng.uniform(-60.0, 60.0, n),
    }, image_ns


MAX_ERROR = {
    "x_m": 1 / 32,
    "y_m": 1 / 32,
    "vx_mps": 1 / 32,
    "length_m": 0.25,
    "width_m": 0.025,
    "accel_x_mps2": 0.015,
    "angle_rate": 0.005,
    "scale_change": 1e-4,
    "radar_x_m": 1 / 32,
}


@given(seed=st.integers(0, 100_000), n=st.integers(1, 60))
@settings(max_examples=25)
def test_decoded_obstacles_are_within_half_a_step(seed: int, n: int) -> None:
    columns, image_ns = scene(seed, n)
    blocks = bursts_of(np.array(image_ns, dtype=np.int64), Table(columns), UNROTATED)
    sent = tables_of(blocks)["obstacles"]
    found = tables_of(decode(encode_tables(blocks, UNROTATED, "can1"), UNROTATED))["obstacles"]

    assert len(sent) == len(found)
    for name, max_error in MAX_ERROR.items():
        np.testing.assert_allclose(values(found, name), values(sent, name), atol=max_error + 1e-9)
    for name in ("obstacle_id", "type", "status", "age_frames", "cipv", "brake_lights", "slot"):
        np.testing.assert_array_equal(found[name], sent[name])
    is_matched = ~np.isnan(values(sent, "radar_x_m"))
    radar = values(found, "radar_vx_mps")
    np.testing.assert_allclose(
        radar[is_matched], values(sent, "radar_vx_mps")[is_matched], atol=1 / 32
    )
    assert np.isnan(radar[~is_matched]).all()


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("width_m", np.nan, r"obstacles width_m, row 0: cannot encode nan; expected 0 to 12.5 m"),
        ("type", 9, r"obstacles type, row 0: cannot encode 9; expected 0 to 7"),
        ("obstacle_id", -1, r"obstacles obstacle_id, row 0: cannot encode -1; expected 0 to 255"),
        ("radar_x_m", 400.0, r"obstacles radar_x_m, row 0: cannot encode"),
    ],
)
def test_value_out_of_message_range_is_refused(column: str, value: float, message: str) -> None:
    t_ns = np.array([10**18])
    objects = {"x_m": np.array([30.0]), "y_m": np.array([0.0]), column: np.array([value])}
    with pytest.raises(ValueError, match=message):
        encode_tables(bursts_of(t_ns, Table(objects | {"t_ns": t_ns}), UNROTATED), UNROTATED)


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
