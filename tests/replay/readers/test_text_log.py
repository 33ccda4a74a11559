"""Lines of numbers as a log: what is read, and what is dropped with a reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crosscue.replay.columns import Table
from crosscue.replay.ledger import Ledger
from crosscue.replay.readers.text_log import MAX_LINE, Row, TextLog


def row_of(line: str) -> Row:
    t_ns, *values = line.split()
    return int(t_ns), *map(float, values)


@pytest.mark.parametrize(
    "line",
    ["not a number", "5 1.0", "5 1.0 2.0 3.0", f"{1 << 64} 1.0 2.0", "5 1.0 " + "2" * MAX_LINE],
)
def test_invalid_line_is_dropped_and_others_are_read(line: str, tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_text(f"1 2.0 3.0\n{line}\n9 4.0 5.0\n")
    ledger = Ledger("log.txt")

    (block,) = TextLog(path, "text", "/rows", ["x_m", "y_m"], row_of).read(ledger)

    assert block.log_ns.tolist() == [1, 9]
    assert isinstance(block.rows, Table)
    assert {name: block.rows.columns[name].tolist() for name in block.rows.columns} == {
        "x_m": [2.0, 4.0],
        "y_m": [3.0, 5.0],
    }
    assert block.rows.columns["x_m"].dtype == np.float64
    account = ledger.topic("/rows")
    assert (account.found, sum(account.dropped.values())) == (2, 1)
