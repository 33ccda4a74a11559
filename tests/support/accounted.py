"""Reading a whole log, with every row accounted for."""

from collections import Counter
from pathlib import Path

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import Block
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import DEFAULT_LIMITS, Limits
from crosscue.replay.logs.opening import open_log


def read(
    path: Path, selection: Selection = EVERYTHING, limits: Limits = DEFAULT_LIMITS
) -> tuple[list[Block], Ledger]:
    """Read all blocks, and check that every row found was skipped or used and returned."""
    ledger = Ledger(str(path))
    with open_log(path, limits) as log:
        blocks = list(log.read(ledger, selection))
    returned = Counter[str]()
    for block in blocks:
        returned[block.topic] += len(block)
    for name, account in ledger.accounts.items():
        assert account.found == account.used + account.skipped.total()
        assert returned.pop(name, 0) == account.used
    assert not returned
    return blocks, ledger
