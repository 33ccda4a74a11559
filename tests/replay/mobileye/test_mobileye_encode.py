"""Tables encoded as frames and decoded again are equal, and vice versa."""

from __future__ import annotations

from math import atan2, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.base import Block, CanFrames, Floats, Ledger, Table
from crosscue.replay.mobileye.can.decode import MobileyeDecoder
from crosscue.replay.mobileye.can.encode import FRAME_NS, LATENCY_NS, bursts_of, encode_tables
from crosscue.replay.mobileye.geometry import Mounting
from crosscue.replay.mobileye.layout import Columns, Message, layout
from crosscue.replay.mobileye.settings import MobileyeSettings
from crosscue.replay.mobileye.tables import LEFT, RIGHT, table_block
from support.mobileye_frames import MS, block_of, random_drive, random_words, values

MOUNTED = MobileyeSettings(mounting=Mounting(1.85, -0.1, 0.02))
STRAIGHT = MobileyeSettings(mounting=Mounting(1.85, -0.1))


def encode_burst(
    image_ns: int,
    objects: Table,
    settings: MobileyeSettings,
    *,
    latency_ns: int = LATENCY_NS,
) -> Block:
    """The frames of one image: a status frame, then A, B and C of each obstacle that is sent."""
    times = np.array([image_ns], dtype=np.int64)
    objects = Table({**objects.columns, "t_ns": np.full(len(objects), image_ns, dtype=np.int64)})
    return encode_tables(bursts_of(times, objects, settings, latency_ns=latency_ns), settings)


def decode(block: Block, how: MobileyeSettings) -> list[Block]:
    ledger = Ledger("log")
    decoder = MobileyeDecoder("can1", ledger, how)
    decoded = decoder(block) + decoder.flush()
    assert not ledger.topic("can1").skipped
    return decoded


def table(blocks: list[Block], name: str) -> Table:
    rows = [b.rows for b in blocks if b.topic.endswith(f"/{name}")]
    tables = [r for r in rows if isinstance(r, Table)]
    return Table({n: np.concatenate([t[n] for t in tables]) for n in tables[0].columns})


def assert_same_frames(got: Block, want: Block) -> None:
    assert isinstance(got.rows, CanFrames)
    assert isinstance(want.rows, CanFrames)
    np.testing.assert_array_equal(got.log_ns, want.log_ns)
    np.testing.assert_array_equal(got.rows.arbitration_id, want.rows.arbitration_id)
    np.testing.assert_array_equal(got.rows.length, want.rows.length)
    np.testing.assert_array_equal(got.rows.data, want.rows.data)


@pytest.mark.slow
@pytest.mark.parametrize("revision", ["classic", "2.32"])
@pytest.mark.parametrize("how", [MOUNTED, STRAIGHT])
@given(seed=st.integers(0, 100_000))
@settings(max_examples=12, deadline=None)
def test_encoding_what_was_decoded_gives_the_same_frames(
    revision: str, how: MobileyeSettings, seed: int
) -> None:
    """Complete bursts with lanes; random lanes cannot be rotated exactly and are only moved."""
    drive = random_drive(5, np.random.default_rng(seed), revision, has_lanes=how is STRAIGHT)
    assert_same_frames(encode_tables(decode(drive, how), how, "can1"), drive)


def plain_messages() -> list[tuple[Message, str]]:
    """Every message that belongs to no burst, in each of its variants."""
    joined = ("status", "obstacles", "lanes", "next_lanes")
    return [
        (message, variant)
        for message in layout().messages
        if message.table not in joined
        for variant in sorted(
            {f.only for f in message.fields if f.only} | set(message.variants.values())
        )
        or [""]
    ]


@pytest.mark.parametrize(
    ("message", "variant"), plain_messages(), ids=lambda x: getattr(x, "name", x)
)
def test_every_message_comes_back_byte_for_byte(message: Message, variant: str) -> None:
    n = 40
    words = random_words(message, n, np.random.default_rng(3), variant)
    ids = np.array(message.ids)[np.arange(n) % len(message.ids)]
    lengths = np.full(n, message.length_of(variant))
    sent = block_of(words, ids, lengths, np.arange(n) * MS)
    how = settings_for(variant)

    assert_same_frames(encode_tables(decode(sent, how), how, "can1"), sent)


def settings_for(variant: str) -> MobileyeSettings:
    here = Mounting(1.85, -0.1)
    return {
        "classic": MobileyeSettings(revision="classic", mounting=here),
        "2.32": MobileyeSettings(revision="2.32", mounting=here),
        "extended": MobileyeSettings(family="extended", mounting=here),
        "tsr": MobileyeSettings(family="tsr", mounting=here),
    }.get(variant, MobileyeSettings(mounting=here))


def scene(seed: int, n: int) -> tuple[Columns, list[int]]:
    """Objects as the table ``obstacles``, within the range of the device."""
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


HALF_STEP = {
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
@settings(max_examples=25, deadline=None)
def test_decoding_what_was_encoded_is_within_half_a_step(seed: int, n: int) -> None:
    columns, image_ns = scene(seed, n)
    blocks = bursts_of(np.array(image_ns, dtype=np.int64), Table(columns), STRAIGHT)
    sent = table(blocks, "obstacles")
    back = table(decode(encode_tables(blocks, STRAIGHT, "can1"), STRAIGHT), "obstacles")

    assert len(sent) == len(back)
    for name, half in HALF_STEP.items():
        np.testing.assert_allclose(values(back, name), values(sent, name), atol=half + 1e-9)
    for name in ("obstacle_id", "type", "status", "age_frames", "cipv", "brake_lights", "slot"):
        np.testing.assert_array_equal(back[name], sent[name])
    is_matched = ~np.isnan(values(sent, "radar_x_m"))
    radar = values(back, "radar_vx_mps")
    np.testing.assert_allclose(
        radar[is_matched], values(sent, "radar_vx_mps")[is_matched], atol=1 / 32
    )
    assert np.isnan(radar[~is_matched]).all()


def test_the_simulated_angle_is_the_bearing_from_the_device() -> None:
    objects = Table({"x_m": np.array([21.85]), "y_m": np.array([4.9])})
    back = table(decode(encode_burst(10**18, objects, STRAIGHT), STRAIGHT), "obstacles")
    on_wire = frame_words(encode_burst(10**18, objects, STRAIGHT), 0x73B)

    assert values(back, "angle_rad")[0] == pytest.approx(atan2(5.0, 20.0), abs=0.005 * pi / 180)
    assert (on_wire >> 48) - (1 << 16) == round(-atan2(5.0, 20.0) * 180 / pi * 100)


def frame_words(block: Block, identifier: int) -> int:
    assert isinstance(block.rows, CanFrames)
    row = int(np.flatnonzero(block.rows.arbitration_id == identifier)[0])
    return int.from_bytes(block.rows.data[row].tobytes(), "little")


def test_what_is_not_given_is_sent_as_missing() -> None:
    objects = Table({"x_m": np.array([30.0]), "y_m": np.array([0.0])})
    back = table(decode(encode_burst(10**18, objects, STRAIGHT), STRAIGHT), "obstacles")

    for name in ("length_m", "radar_x_m", "radar_vx_mps", "accel_x_mps2"):
        assert np.isnan(values(back, name)).all(), name
    assert back["radar_id"].tolist() == [-1]
    assert back["valid"].tolist() == [1]


def test_the_nearest_objects_get_the_slots_and_far_ones_none() -> None:
    x_m = np.append(np.linspace(240.0, 20.0, 16), [252.0, 1.0, 50.0])
    y_m = np.append(np.zeros(18), [35.0])
    back = table(
        decode(encode_burst(10**18, Table({"x_m": x_m, "y_m": y_m}), STRAIGHT), STRAIGHT),
        "obstacles",
    )

    assert len(back) == 13
    assert (np.diff(values(back, "x_m")) > 0).all()
    assert values(back, "x_m")[0] == pytest.approx(20.0, abs=1 / 32)


def test_frames_of_a_burst_follow_one_another() -> None:
    objects = Table({"x_m": np.array([30.0, 40.0]), "y_m": np.array([0.0, 1.0])})
    block = encode_burst(10**18, objects, STRAIGHT, latency_ns=70 * MS)

    assert isinstance(block.rows, CanFrames)
    assert block.rows.arbitration_id.tolist() == [0x738, *range(0x739, 0x73F)]
    assert block.log_ns[0] == 10**18 + 70 * MS
    assert np.diff(block.log_ns).tolist() == [FRAME_NS] * 6


def test_an_image_without_objects_is_a_burst_of_none() -> None:
    empty = Table({"x_m": np.zeros(0), "y_m": np.zeros(0)})
    assert len(encode_burst(10**18, empty, STRAIGHT)) == 1


@pytest.mark.parametrize("how", [STRAIGHT, MOUNTED])
def test_lanes_come_back_within_half_a_step_of_the_wire(how: MobileyeSettings) -> None:
    n = 30
    rng = np.random.default_rng(5)
    side = np.where(np.arange(n) % 2 == 0, LEFT, RIGHT).astype(np.int8)
    columns: Columns = {
        "side": side,
        "c0_m": side * rng.uniform(1.0, 2.5, n),
        "c1": rng.uniform(-0.05, 0.05, n),
        "c2_per_m": rng.uniform(-1e-3, 1e-3, n),
        "c3_per_m2": rng.uniform(-1e-6, 1e-6, n),
        "view_range_m": rng.uniform(20.0, 90.0, n),
        "lane_type": np.ones(n, dtype=np.int16),
        "quality": np.full(n, 3, dtype=np.int16),
    }
    sent = table_block("can1", "lanes", np.arange(n) * 100 * MS, columns)
    back = table(decode(encode_tables([sent], how, "can1"), how), "lanes")

    np.testing.assert_array_equal(back["side"], side)
    for x_m in (2.0, 20.0):
        want = cubic(columns, x_m)
        got = cubic(dict(back.columns), x_m)
        steps_m = 1 / 512 + x_m / 2048 + x_m**2 / 2048000 + x_m**3 / 2**29
        assert np.abs(want - got).max() <= steps_m + 1e-5


def cubic(columns: Columns, x_m: float) -> Floats:
    c = [columns[name].astype(np.float64) for name in ("c0_m", "c1", "c2_per_m", "c3_per_m2")]
    y_m: Floats = c[0] + c[1] * x_m + c[2] * x_m**2 + c[3] * x_m**3
    return y_m


def test_a_side_without_a_marking_is_sent_as_such() -> None:
    nothing = np.full(2, np.nan)
    columns: Columns = {"side": np.array([LEFT, RIGHT], dtype=np.int8)}
    columns |= dict.fromkeys(("c0_m", "c1", "c2_per_m", "c3_per_m2", "view_range_m"), nothing)
    sent = table_block("can1", "lanes", np.array([0, MS]), columns)
    frames = encode_tables([sent], MOUNTED, "can1")

    assert frame_words(frames, 0x766) & 0xFFFFFF == (-480 & 0xFFFF) << 8 | 2
    assert frame_words(frames, 0x768) & 0xFFFFFF == 480 << 8 | 2
    assert table(decode(frames, MOUNTED), "lanes")["has_marking"].tolist() == [False, False]


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("width_m", np.nan, r"obstacles width_m, row 0: cannot encode nan; expected 0 to 12.5 m"),
        ("type", 9, r"obstacles type, row 0: cannot encode 9; expected 0 to 7"),
        ("obstacle_id", -1, r"obstacles obstacle_id, row 0: cannot encode -1; expected 0 to 255"),
        ("radar_x_m", 400.0, r"obstacles radar_x_m, row 0: cannot encode"),
    ],
)
def test_what_the_wire_cannot_carry_is_refused(column: str, value: float, message: str) -> None:
    objects = Table({"x_m": np.array([30.0]), "y_m": np.array([0.0]), column: np.array([value])})
    with pytest.raises(ValueError, match=message):
        encode_burst(10**18, objects, STRAIGHT)


def test_speeds_beyond_the_wire_are_clipped_as_the_table_declares() -> None:
    objects = Table({"x_m": np.array([30.0]), "y_m": np.zeros(1), "vx_mps": np.array([-200.0])})
    back = table(decode(encode_burst(10**18, objects, STRAIGHT), STRAIGHT), "obstacles")
    assert values(back, "vx_mps").tolist() == [-127.9375]


def test_tables_and_bursts_that_do_not_fit_are_refused() -> None:
    times = np.zeros(1, dtype=np.int64)
    with pytest.raises(ValueError, match="no such table: lidar; there are: status"):
        encode_tables([Block("can1/lidar", times, Table({"t_ns": times}))])
    lonely: Columns = {"burst": times + 4, "slot": times, "x_m": times + 9.0, "y_m": times + 0.0}
    with pytest.raises(ValueError, match="obstacles of burst 4: expected a status row"):
        encode_tables([table_block("can1", "obstacles", times, lonely)])
    with pytest.raises(ValueError, match="expected increasing times"):
        bursts_of(np.array([1, 1]), Table({"t_ns": times, "x_m": times, "y_m": times}))
    with pytest.raises(ValueError, match="expected times from image_ns"):
        bursts_of(np.array([1, 2]), Table({"t_ns": times, "x_m": times, "y_m": times}))
