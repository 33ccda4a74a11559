"""What becomes of messages that give no row: damaged ones are dropped, foreign ones skipped."""

from __future__ import annotations

from typing import Final

from crosscue.replay.base import Block, Ledger

MISFIT: Final = "does not fit its schema"
WRONG_CODING: Final = "CDR representation not supported"
EMPTY_PICTURE: Final = "empty picture"
IMAGE_CODING: Final = "image coding not known"
VIDEO_CODING: Final = "video coding not known"
BIG_ENDIAN: Final = "big-endian pixels not supported"
LONG_LENS: Final = "over 14 lens coefficients"

FOREIGN: Final = frozenset(
    {WRONG_CODING, EMPTY_PICTURE, IMAGE_CODING, VIDEO_CODING, BIG_ENDIAN, LONG_LENS}
)
"""Reasons of messages that are whole and that nothing here decodes; any other reason is damage."""


def refuse(
    ledger: Ledger, block: Block, first: int, reason: str, why: str = "", count: int = 1
) -> None:
    """Put messages that give no row into the account.

    Args:
        ledger: The log's.
        block: As read.
        first: Which of its rows is the first of them, for its time.
        reason: Short; decides between skipped and dropped.
        why: The detail.
        count: How many there are.
    """
    put = ledger.skip if reason in FOREIGN else ledger.spoil
    put(block.topic, reason, count, why, int(block.log_ns[first]))
