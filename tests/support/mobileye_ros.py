"""Mobileye frames as decoded ROS messages.

They are those of a hypothetical driver that copies each field, with values as on the wire and types
as in the message definitions.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Block, CanFrames, Floats, Int64s, Table
from crosscue.replay.mobileye.bits import extract, leading_words
from crosscue.replay.mobileye.layout import BitField, Message, layout
from crosscue.replay.mobileye.wire import from_raw

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
