"""Decoded rows of one topic over a time range, for plots and notebooks.

Where the log has an index, only the relevant parts are read; see ``Log.read``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.base import Log, Selection, name_of
from crosscue.replay.columns import Block, CanFrames, Images, Table, Topic
from crosscue.replay.decode import decoder_for
from crosscue.replay.errors import UsageError
from crosscue.replay.ledger import Ledger


@dataclass(frozen=True, slots=True, eq=False)
class TopicPart:
    """Rows of one topic.

    Attributes:
        topic: The topic.
        blocks: Rows in stored order, as columns where the type is known, else as messages.
        ledger: Account of this pass over the log.
    """

    topic: Topic
    blocks: tuple[Block, ...]
    ledger: Ledger

    def __len__(self) -> int:
        return sum(map(len, self.blocks))


def read_topic(
    log: Log, name: str, start_ns: int | None = None, end_ns: int | None = None
) -> TopicPart:
    """Read the rows of one topic with ``start_ns <= log time < end_ns`` into memory.

    Args:
        log: An open log.
        name: Name of the topic.
        start_ns: First log time, or None for the log's beginning.
        end_ns: End of the log times, exclusive, or None for the log's end.

    Raises:
        UsageError: The log has no such topic; the message lists the available topics.
        SchemaError: The log's definition of the type is damaged.
    """
    topic = next((one for one in log.topics if one.name == name), None)
    if topic is None:
        known = ", ".join(one.name for one in log.topics)
        raise UsageError(f"{name_of(log)}: no topic {name!r}; there are: {known}")
    ledger, decode = Ledger(name_of(log)), decoder_for(topic)
    blocks = log.read(ledger, Selection(frozenset({name}), start_ns, end_ns))
    if decode is None:
        return TopicPart(topic, tuple(blocks), ledger)
    return TopicPart(topic, tuple(decode(block, ledger) for block in blocks), ledger)


def topic_columns(blocks: Sequence[Block]) -> dict[str, NDArray[np.generic]]:
    """Return the rows of one topic as flat columns of equal length: times, then fields.

    A column of vectors becomes one column per component: ``gyro.0``, ``gyro.1``. A field of the
    message that is itself named ``log_t_ns`` becomes ``log_t_ns_``.

    Args:
        blocks: At least one block of ``Table``, ``CanFrames`` or ``Images``, all with the same
            columns. Payloads of CAN frames and pictures are omitted.
    """
    columns: dict[str, NDArray[np.generic]] = {"log_t_ns": _joined([b.log_ns for b in blocks])}
    for name in ("publish_ns", "header_ns"):
        parts = [part for block in blocks if (part := getattr(block, name)) is not None]
        if len(parts) == len(blocks):
            columns[name] = _joined(parts)
    rows = [_named(block.rows) for block in blocks]
    for name in rows[0]:
        joined = _joined([one[name] for one in rows])
        if joined.ndim == 1:
            columns[f"{name}_" if name == "log_t_ns" else name] = joined
            continue
        flat = joined.reshape(len(joined), -1)
        columns |= {f"{name}.{i}": flat[:, i] for i in range(flat.shape[1])}
    return columns


def _joined(parts: Sequence[NDArray[np.generic]]) -> NDArray[np.generic]:
    """Return the parts as one array; a single part is not copied."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _named(rows: object) -> dict[str, NDArray[np.generic]]:
    if isinstance(rows, Table):
        return dict(rows.columns)
    if isinstance(rows, Images):
        sizes = ("width_px", "height_px", "step_bytes")
        found = {name: getattr(rows, name) for name in sizes}
        found["pixel_format"] = None if rows.pixel_format is None else np.array(rows.pixel_format)
        return {name: values for name, values in found.items() if values is not None}
    assert isinstance(rows, CanFrames)
    return {
        name: getattr(rows, name)
        for name in ("arbitration_id", "is_extended", "kind", "length", "is_fd")
    }
