"""Reading a whole log, with every row accounted for."""

from collections import Counter
from pathlib import Path

import numpy as np

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import Block, Floats, Table
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
        assert account.declared in (None, account.in_file) or not account.is_whole
        assert returned.pop(name, 0) == account.used
    assert not returned
    return blocks, ledger


def read_topics(
    path: Path, selection: Selection = EVERYTHING
) -> tuple[dict[str, list[Block]], Ledger]:
    blocks, ledger = read(path, selection)
    found: dict[str, list[Block]] = {}
    for block in blocks:
        found.setdefault(block.topic, []).append(block)
    return found, ledger


def times(blocks: list[Block]) -> list[int]:
    return [t_ns for block in blocks for t_ns in block.log_ns.tolist()]


def column(blocks: list[Block], name: str) -> Floats:
    """A column of tables, as float64."""
    tables = [block.rows for block in blocks]
    assert all(isinstance(table, Table) for table in tables)
    parts = [np.asarray(table[name], np.float64) for table in tables if isinstance(table, Table)]
    return np.concatenate(parts)
