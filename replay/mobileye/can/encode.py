"""Encode tables as the frames of a Mobileye, the inverse of the decoder, for simulation and tests.

Values are rounded to the wire's steps. The layout table specifies the treatment of values outside a
field's range: most fields refuse them, some clip them, and an obstacle too far away is not sent.
"""

from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import DATA, Block, CanFrames, Floats, Int64s, Table
from crosscue.replay.mobileye.bits import Words, payloads_of
from crosscue.replay.mobileye.clock import MS
from crosscue.replay.mobileye.geometry import AT_REAR_AXLE, DevicePosition
from crosscue.replay.mobileye.layout import (
    LANE_PARTS,
    OBSTACLE_PARTS,
    UNKNOWN,
    VARIANTS,
    Column,
    Columns,
    Message,
    Variant,
    layout,
    variant_number,
)
from crosscue.replay.mobileye.settings import DEFAULTS, MobileyeSettings
from crosscue.replay.mobileye.tables import floats, instance_of_lane, table_block, to_device
from crosscue.replay.mobileye.wire import words_from

# Approximate duration of a frame of 8 bytes at 500 kbit/s.
FRAME_NS: Final = 250_000
# Default time from image to status frame, a plausible value that was not measured.
LATENCY_NS: Final = 80 * MS


class _Sent(NamedTuple):
    """Frames of one message and their times."""

    log_ns: Int64s
    arbitration_id: NDArray[np.int64]
    length: NDArray[np.int64]
    words: Words


def encode_tables(
    tables: Iterable[Block], settings: MobileyeSettings = DEFAULTS, bus: str = "mobileye"
) -> Block:
    """Encode tables as frames, in the order of their times.

    A status frame is sent at its row's log time. The obstacles of its burst follow it, slot by
    slot, one frame every ``FRAME_NS``. The second half of a lane follows its first. Derived columns
    (``x_start_m``, ``latency_ns``, ...) are ignored. Absent columns are sent as missing, or as the
    layout's default.

    Args:
        tables: Blocks of a ``MobileyeDecoder``; the part of the topic after the last ``/`` is the
            name of the table.
        settings: Revision (``auto``: classic, unless a status row specifies it) and family
            (``auto``: extended) to send, and the mounting.
        bus: Topic of the frames.

    Raises:
        ValueError: A value cannot be encoded.
    """
    named = [(block.topic.rpartition("/")[2], block) for block in tables]
    # The messages of a table are consecutive.
    order = {message.table: place for place, message in enumerate(layout().values())}
    sent: list[_Sent] = []
    # At equal times the status is sent first, because it starts the burst of the other frames.
    for name, block in sorted(named, key=lambda one: order[one[0]]):
        sent += _sent(name, block, settings)
    return _frames(sent, bus)


def bursts_of(
    image_ns: Int64s,
    objects: Table,
    settings: MobileyeSettings = DEFAULTS,
    *,
    latency_ns: int | Int64s = LATENCY_NS,
    bus: str = "mobileye",
) -> list[Block]:
    """Convert objects to the tables ``status`` and ``obstacles`` for ``encode_tables``.

    The nearest objects of each image are assigned to the slots, nearest first. Objects outside the
    range of the device (250 m ahead, behind it, 32 m to the side) are omitted.

    Args:
        image_ns: Grab times of all images, including those without objects, shape (M,), increasing.
        objects: Columns of the table ``obstacles``; ``t_ns`` is one of ``image_ns``.
        settings: Slots and mounting.
        latency_ns: Time from image to status frame, of all images or of each.
        bus: First part of the topics.
    """
    burst = np.searchsorted(image_ns, objects["t_ns"].astype(np.int64))
    mounting = settings.mounting or AT_REAR_AXLE
    ahead_m, seen = _seen(objects, mounting)
    order = np.lexsort((ahead_m[seen], burst[seen]))
    rows = np.flatnonzero(seen)[order]
    burst = burst[rows]
    slot = np.arange(len(rows)) - np.searchsorted(burst, burst)
    rows, burst, slot = (c[slot < settings.slots] for c in (rows, burst, slot))
    log_ns = image_ns + np.asarray(latency_ns, dtype=np.int64)
    status: Columns = {
        "t_ns": image_ns,
        "burst": np.arange(len(image_ns), dtype=np.int64),
        "count": np.bincount(burst, minlength=len(image_ns)).astype(np.int16),
        "counter_ms": (image_ns // MS & 0xFF).astype(np.int16),
        "stop_go": np.full(len(image_ns), 15, dtype=np.int16),
        "protocol_version": np.full(len(image_ns), 3, dtype=np.int16),
    }
    obstacles: Columns = {**objects.take(rows).columns, "burst": burst, "slot": slot}
    return [
        table_block(bus, "status", log_ns, status, image_ns),
        table_block(bus, "obstacles", log_ns[burst], obstacles, image_ns[burst]),
    ]


def _seen(objects: Table, mounting: DevicePosition) -> tuple[Floats, NDArray[np.bool_]]:
    """Return distances ahead of the device, and a mask of the objects that it would report."""
    on_device = to_device("obstacles", dict(objects.columns), mounting)
    seen = np.ones(len(objects), dtype=np.bool_)
    for f in layout()["obstacle_a"].fields:
        if f.beyond == "drop" and f.low is not None and f.high is not None:
            place_m = floats(on_device[f.name])
            seen &= (place_m >= f.low) & (place_m <= f.high)
    return floats(on_device["x_m"]), seen


def _sent(name: str, block: Block, settings: MobileyeSettings) -> list[_Sent]:
    rows = block.rows
    assert isinstance(rows, Table)
    columns = to_device(name, dict(rows.columns), settings.mounting or AT_REAR_AXLE)
    instance, log_ns = np.zeros(len(rows), dtype=np.int64), block.log_ns
    if name == "obstacles":
        instance = columns["slot"].astype(np.int64)
        log_ns = log_ns + (1 + len(OBSTACLE_PARTS) * instance) * FRAME_NS
        if "angle_rad" not in columns:
            columns["angle_rad"] = np.arctan2(floats(columns["y_m"]), floats(columns["x_m"]))
    elif name in LANE_PARTS:
        instance = instance_of_lane(name, columns)
    elif name == "signs":
        instance = columns["sign"].astype(np.int64) - 1
    messages = (message for message in layout().values() if message.table == name)
    return [
        _message(message, columns, instance, log_ns + k * FRAME_NS, settings, block.topic)
        for k, message in enumerate(messages)
    ]


def _message(
    message: Message,
    columns: Mapping[str, Column],
    instance: Int64s,
    log_ns: Int64s,
    settings: MobileyeSettings,
    topic: str,
) -> _Sent:
    variant = _variant(message, columns, len(log_ns), settings)
    words = words_from(message, columns, variant, topic)
    length_of = [message.length_of(name) for name in (*VARIANTS, "")]  # the last is for UNKNOWN
    return _Sent(
        log_ns,
        np.array(message.ids, dtype=np.int64)[instance],
        np.array(length_of, dtype=np.int64)[variant],
        words,
    )


def _variant(
    message: Message, columns: Mapping[str, Column], n: int, settings: MobileyeSettings
) -> Variant:
    if message.variant and "layout" in columns:
        return columns["layout"].astype(np.int8)
    name: str = "classic" if settings.revision == "auto" else settings.revision
    if message.variant == "family":
        name = "extended" if settings.family == "auto" else settings.family
    elif message.variant == "length" and name not in message.variants.values():
        name = "basic"
    return np.full(n, variant_number(name) if message.variant else UNKNOWN, dtype=np.int8)


def _frames(sent: Iterable[_Sent], bus: str) -> Block:
    columns = [np.concatenate(column) for column in zip(_no_frames(), *sent, strict=True)]
    order = np.argsort(columns[0], kind="stable")
    log_ns, ids, length, words = (column[order] for column in columns)
    n = len(log_ns)
    frames = CanFrames(
        ids.astype(np.uint32),
        np.zeros(n, dtype=np.bool_),
        np.full(n, DATA, dtype=np.uint8),
        length.astype(np.uint8),
        payloads_of(words.astype(np.uint64)),
        np.zeros(n, dtype=np.bool_),
    )
    return Block(bus, log_ns, frames)


def _no_frames() -> _Sent:
    none = np.zeros(0, dtype=np.int64)
    return _Sent(none, none, none, np.zeros(0, dtype=np.uint64))
