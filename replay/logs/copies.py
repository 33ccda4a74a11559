"""Rows that are stored twice: the stamp and the content of the row before."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Block, CanFrames, Images, Messages


def copies(block: Block) -> int:
    """Return the number of rows that are exact copies of the row before.

    The stamp is that of the sensor where it is set; a recorder may store a copy a moment later.
    """
    same = np.diff(block.log_ns) == 0
    if block.header_ns is not None:
        is_set = block.header_ns[1:] > 0
        same = np.where(is_set, np.diff(block.header_ns) == 0, same)
    if not same.any():
        return 0
    rows = block.rows
    if isinstance(rows, Messages | Images):
        messages = rows.bytes_ if isinstance(rows, Images) else rows
        same &= np.diff(messages.stop - messages.start) == 0
        at = np.flatnonzero(same).tolist()
        return sum(messages.payload(i) == messages.payload(i + 1) for i in at)
    columns = _can(rows) if isinstance(rows, CanFrames) else rows.columns.values()
    for column in columns:
        equal = (column[1:] == column[:-1]) | ((column[1:] != column[1:]) & _nan(column[:-1]))
        same &= equal.reshape(len(same), -1).all(axis=1)
    return int(same.sum())


def _can(rows: CanFrames) -> Iterator[NDArray[np.generic]]:
    yield from (rows.arbitration_id, rows.is_extended, rows.kind, rows.length, rows.data)


def _nan(column: NDArray[np.generic]) -> NDArray[np.bool_]:
    return np.asarray(column != column, np.bool_)
