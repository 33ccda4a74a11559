"""CAN frames for tests: those of a real drive."""

from __future__ import annotations

import numpy as np

from crosscue.replay.columns import Block, CanFrames

from .data import shared


def comma2k19_frames(bus: int) -> Block:
    """All frames of one bus of the real minute; 8 bytes each, since the set lost the lengths."""
    folder = shared(
        *("comma2k19", "Example_1", "b0c9d2329ad1606b_2018-08-02--08-34-47", "40"),
        *("processed_log", "CAN", "raw_can"),
    )
    column = {
        name: np.load(folder / name, allow_pickle=False) for name in ("address", "data", "src", "t")
    }
    rows = np.flatnonzero(column["src"] == bus)
    address = column["address"][rows]
    frames = CanFrames(
        arbitration_id=address.astype(np.uint32),
        is_extended=address > 0x7FF,
        kind=np.zeros(len(rows), dtype=np.uint8),
        length=np.full(len(rows), 8, dtype=np.uint8),
        # Element access would drop trailing zero bytes of the |S8 column; its buffer has them.
        data=np.ascontiguousarray(column["data"].view(np.uint8).reshape(-1, 8)[rows]),
        is_fd=np.zeros(len(rows), dtype=np.bool_),
    )
    return Block(f"can{bus}", np.round(column["t"][rows] * 1e9).astype(np.int64), frames)
