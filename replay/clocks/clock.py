"""The three times of a row, and the times of rows on one of these clocks."""

from enum import Enum
from typing import Final

import numpy as np

from crosscue.replay.columns import Block, Int64s

# Upper bound on valid stamps, in the year 2116; below it, differences fit into 64 bits.
LATEST_NS: Final = 1 << 62


class Clock(Enum):
    """One of a row's times."""

    LOG = "log time"
    PUBLISH = "publish time"
    HEADER = "header stamp"


def times_of(block: Block, clock: Clock) -> Int64s:
    """Return the times of a block's rows on ``clock``, shape (N,).

    A row without a valid stamp (absent, 0 or absurd) has its log time, so times stay comparable.
    """
    column = {Clock.PUBLISH: block.publish_ns, Clock.HEADER: block.header_ns}.get(clock)
    if column is None:
        return block.log_ns
    return np.where((column > 0) & (column < LATEST_NS), column, block.log_ns)
