"""Account for messages that yield no row: damaged ones are dropped, unsupported ones skipped."""

from typing import Final

from crosscue.replay.columns import Block
from crosscue.replay.ledger import Ledger

MISFIT: Final = "does not fit its schema"
WRONG_CODING: Final = "CDR representation not supported"
EMPTY_PICTURE: Final = "empty picture"
IMAGE_CODING: Final = "unknown image coding"
VIDEO_CODING: Final = "unknown video coding"
BIG_ENDIAN: Final = "big-endian pixels not supported"
LONG_LENS: Final = "over 14 lens coefficients"

# Reasons for intact messages that are not supported; any other reason means damage.
FOREIGN: Final = frozenset(
    {WRONG_CODING, EMPTY_PICTURE, IMAGE_CODING, VIDEO_CODING, BIG_ENDIAN, LONG_LENS}
)


def refuse(
    ledger: Ledger, block: Block, first: int, reason: str, why: str = "", count: int = 1
) -> None:
    """Count messages that yield no row.

    Args:
        ledger: The log's ledger.
        block: The block as read.
        first: Index in the block of the first of these messages, for its time.
        reason: Short reason, which decides between skipped and dropped.
        why: Detail of the reason.
        count: Number of messages.
    """
    put = ledger.skip if reason in FOREIGN else ledger.spoil
    put(block.topic, reason, count, why, int(block.log_ns[first]))
