"""Flat columns of the decoded rows of one topic, for tables, plots and notebooks."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Block, CanFrames, Images, Table


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
