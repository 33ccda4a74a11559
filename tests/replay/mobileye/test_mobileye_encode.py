"""Encoding and decoding of Mobileye tables are inverse to each other."""

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
from crosscue.replay.mobileye.settings import MobileyeSettings
from support.mobileye_frames import MS, block_of, random_drive, random_words, tables_of, values

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
        for message in layout().messages
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
