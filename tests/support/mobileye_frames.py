"""Mobileye frames, by hand or random, and the same data as ROS messages."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import DATA, Block, CanFrames, Floats, Int64s, Table
from crosscue.replay.mobileye.bits import Words, extract, leading_words, payloads_of, place_bits
from crosscue.replay.mobileye.layout import BitField, Message, layout
from crosscue.replay.mobileye.wire import from_raw
from support.can_layouts import frames_of, join

MS = 1_000_000


def frames(
    sent: Sequence[tuple[int, str]],
    log_ns: Sequence[int] | None = None,
    topic: str = "can1",
    kind: int = DATA,
    is_extended: bool = False,
) -> Block:
    """Frames from pairs of identifier and hexadecimal bytes, by default a millisecond apart."""
    payloads = [bytes.fromhex(text) for _, text in sent]
    n = len(sent)
    data = np.zeros((n, 8), dtype=np.uint8)
    for row, payload in enumerate(payloads):
        data[row, : len(payload)] = list(payload)
    times = list(range(0, n * MS, MS)) if log_ns is None else list(log_ns)
    lengths = [len(payload) for payload in payloads]
    rows = frames_of(data, [i for i, _ in sent], is_extended, lengths, kind)
    return Block(topic, np.array(times, dtype=np.int64), rows)


def status(count: int, counter_ms: int, length: int = 6) -> tuple[int, str]:
    """A status frame that announces ``count`` obstacles."""
    text = f"{count:02X}{counter_ms & 0xFF:02X}00F203"
    return 0x738, text + "00" * (length - len(text) // 2)


def triple(slot: int, mark: int) -> list[tuple[int, str]]:
    """Frames A, B and C of one obstacle slot; ``mark`` is the obstacle's id."""
    first = 0x739 + 3 * slot
    return [
        (first, f"{mark:02X}80010000000300"),
        (first + 1, f"1184{mark:02X}0000000000"),
        (first + 2, f"{mark:02X}00000000103007"),
    ]


def random_words(message: Message, n: int, rng: np.random.Generator, variant: str = "") -> Words:
    """Random payloads within the ranges that the table declares.

    Fields can have their code for a missing value, together with the fields that depend on them.
    """
    words = np.zeros(n, dtype=np.uint64)
    raws: dict[str, Int64s] = {}
    for f in message.fields:
        if f.only not in ("", variant):
            continue
        raw = _random_raw(f, n, rng)
        if f.missing_with:
            other = next(o for o in message.fields if o.name == f.missing_with)
            is_missing = np.isin(raws[other.name], other.missing)
            raw = np.where(is_missing, f.missing[0], _random_present(f, n, rng))
        raws[f.name] = raw
    for f in message.fields:
        if f.name not in raws or f.only not in ("", variant):
            continue
        raw = raws[f.name]
        if f.needs:
            raw = np.where(raws[f.needs] == 0, f.default, raw)
        words |= place_bits(raw, f.start, f.width, f.order == "big")
    return words


def _random_present(f: BitField, n: int, rng: np.random.Generator) -> Int64s:
    lowest, highest = f.raw_range
    raw = rng.integers(lowest, highest + 1, n)
    ends = rng.integers(0, 8, n)
    raw = np.where(ends == 0, lowest, np.where(ends == 1, highest, raw))
    return np.where(np.isin(raw, f.missing), f.default, raw)


def _random_raw(f: BitField, n: int, rng: np.random.Generator) -> Int64s:
    raw = _random_present(f, n, rng)
    if not f.missing:
        return raw
    return np.where(rng.integers(0, 4, n) == 0, f.missing[0], raw)


def block_of(
    words: Words, ids: Int64s, lengths: Int64s, log_ns: Int64s, topic: str = "can1"
) -> Block:
    data = payloads_of(words)
    data = np.where(np.arange(8) < lengths[:, None], data, 0).astype(np.uint8)
    return Block(topic, log_ns, frames_of(data, ids, length=lengths))


def random_drive(
    bursts: int, rng: np.random.Generator, revision: str = "classic", *, has_lanes: bool = True
) -> Block:
    """Complete bursts of obstacles, lanes and further lanes, as a device sends them."""
    parts: list[Block] = []
    for k in range(bursts):
        log_ns = 10_000 * MS + k * 66 * MS
        count = int(rng.integers(0, 11))
        parts.append(_burst(count, k, log_ns, rng, revision, has_lanes))
    return join(parts)


def _burst(
    count: int, number: int, log_ns: int, rng: np.random.Generator, revision: str, has_lanes: bool
) -> Block:
    step_ns = 250_000
    words, ids, lengths = [], [], []

    def add(message: Message, instance: int, payload: Words, variant: str = "") -> None:
        words.append(int(payload[0]))
        ids.append(message.ids[instance])
        lengths.append(message.length_of(variant))

    opening = random_words(layout()["status"], 1, rng, revision) & ~np.uint64(0xFFFF)
    opening |= np.uint64(count | (number * 66 & 0xFF) << 8)
    add(layout()["status"], 0, opening, revision)
    for slot in range(count):
        for name in ("obstacle_a", "obstacle_b", "obstacle_c"):
            add(layout()[name], slot, random_words(layout()[name], 1, rng))
    for prefix, lanes in (("", 2), ("next_", 8)) if has_lanes else ():
        for lane in range(lanes):
            for half in ("a", "b"):
                message = layout()[f"{prefix}lane_{half}"]
                add(message, lane, random_words(message, 1, rng))
    n = len(words)
    return block_of(
        np.array(words, dtype=np.uint64),
        np.array(ids, dtype=np.int64),
        np.array(lengths, dtype=np.int64),
        log_ns + np.arange(n, dtype=np.int64) * step_ns,
    )


def tables_of(blocks: Iterable[Block]) -> dict[str, Table]:
    """Join the tables of a decoder by the last part of their topics."""
    parts: dict[str, list[Table]] = {}
    for block in blocks:
        assert isinstance(block.rows, Table)
        parts.setdefault(block.topic.rpartition("/")[2], []).append(block.rows)
    joined = {}
    for name, tables in parts.items():
        columns = list(tables[0].columns)
        assert all(list(table.columns) == columns for table in tables)
        joined[name] = Table({c: np.concatenate([t[c] for t in tables]) for c in columns})
    return joined


def values(table: Table, name: str) -> Floats:
    """A column converted to float64."""
    return table[name].astype(np.float64)


TYPES: Final[Mapping[str, str]] = {
    "/parsed_tx/obstacle_status": "ObstacleStatus",
    "/parsed_tx/obstacle_data": "ObstacleData",
    "/parsed_tx/left_lka_lane": "LkaLane",
    "/parsed_tx/right_lka_lane": "LkaLane",
    "/parsed_tx/next_lka_lanes": "LkaLane",
    "/parsed_tx/lane": "Lane",
    "/parsed_tx/aftermarket_lane": "AftermarketLane",
    "/parsed_tx/aws_display": "AwsDisplay",
    "/parsed_tx/tsr": "Tsr",
    "/parsed_tx/ahbc_gradual": "AhbcGradual",
    "/parsed_tx/fixed_foe": "FixedFoe",
}
TOPIC_TYPES: Final = {topic: f"mobileye_560_660_msgs/msg/{name}" for topic, name in TYPES.items()}

_FLOAT32: Final = (
    "obstacle_length",
    "obstacle_width",
    "radar_pos_x",
    "radar_vel_x",
    "obstacle_angle_rate",
    "object_accel_x",
    "obstacle_angle",
    "marking_width",
    "view_range",
    "headway_measurement",
    "distance_to_left_lane",
    "distance_to_right_lane",
    "sign_position_x",
    "sign_position_y",
)


def messages_of(block: Block, only: str = "") -> list[Block]:
    """Return one block of messages for each topic with frames."""
    frames = block.rows
    assert isinstance(frames, CanFrames)
    topics = [
        ("obstacle_status", ("status",), 0),
        *(("obstacle_data", ("obstacle_a", "obstacle_b", "obstacle_c"), k) for k in range(13)),
        ("left_lka_lane", ("lane_a", "lane_b"), 0),
        ("right_lka_lane", ("lane_a", "lane_b"), 1),
        *(("next_lka_lanes", ("next_lane_a", "next_lane_b"), k) for k in range(8)),
        ("lane", ("lane_details",), 0),
        ("aftermarket_lane", ("aftermarket_lane",), 0),
        ("aws_display", ("warnings",), 0),
        *(("tsr", ("sign",), k) for k in range(7)),
        ("ahbc_gradual", ("high_beam_area", "high_beam_state"), 0),
    ]
    made: dict[str, list[Block]] = {}
    for topic, names, instance in topics:
        columns: dict[str, NDArray[np.generic]] = {}
        log_ns: Int64s = np.zeros(0, dtype=np.int64)
        for name in names:
            message = layout()[name]
            rows = frames.arbitration_id == message.ids[instance]
            columns |= _fields(message, leading_words(frames.data[rows]))
            log_ns = log_ns if len(log_ns) else block.log_ns[rows]
        if len(log_ns) and only in ("", topic):
            made.setdefault(f"/parsed_tx/{topic}", []).append(_block(topic, log_ns, columns))
    return [_in_time(blocks) for blocks in made.values()]


def _fields(message: Message, words: NDArray[np.uint64]) -> dict[str, NDArray[np.generic]]:
    columns: dict[str, NDArray[np.generic]] = {}
    for f in message.fields:
        if f.ros:
            columns[f.ros] = _as_sent(f, extract(words, f.start, f.bits, f.signed, False))
    if message.name == "warnings":
        columns["dusk_time"] = (words >> np.uint64(3)) & np.uint64(1) > 0
        columns["night_time"] = (words >> np.uint64(4)) & np.uint64(1) > 0
    return columns


def _as_sent(f: BitField, raw: Int64s) -> NDArray[np.generic]:
    value: Floats = from_raw(replace(f, missing=()), raw)
    if f.kind == "flag":
        return value > 0
    if f.kind == "code":
        return value.astype(np.uint16)
    return value.astype(np.float32) if f.ros in _FLOAT32 else value


def _block(topic: str, log_ns: Int64s, columns: Mapping[str, NDArray[np.generic]]) -> Block:
    return Block(f"/parsed_tx/{topic}", log_ns + 1_000_000, Table(columns), header_ns=log_ns)


def _in_time(blocks: list[Block]) -> Block:
    log_ns = np.concatenate([b.log_ns for b in blocks])
    tables = [b.rows for b in blocks if isinstance(b.rows, Table)]
    columns = {n: np.concatenate([t[n] for t in tables]) for n in tables[0].columns}
    block = Block(blocks[0].topic, log_ns, Table(columns), header_ns=log_ns - 1_000_000)
    return block.take(np.argsort(log_ns, kind="stable"))
