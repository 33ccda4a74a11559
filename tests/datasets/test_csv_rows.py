"""Tables in CSV: what is read, and what is refused."""

from pathlib import Path

import pytest

from crosscue.datasets.truth.csv_rows import csv_rows
from crosscue.replay.errors import AnnotationError
from support.trees import written


def test_rows_have_their_place_also_after_a_byte_order_mark(tmp_path: Path) -> None:
    table = written(tmp_path / "table.csv", "t_ns,range_m\n1,2.5\n3,4.5\n".encode("utf-8-sig"))

    assert list(csv_rows(table, "t_ns,range_m")) == [
        (f"{table}:2", {"t_ns": "1", "range_m": "2.5"}),
        (f"{table}:3", {"t_ns": "3", "range_m": "4.5"}),
    ]


def test_table_without_a_column_is_refused_with_those_it_has(tmp_path: Path) -> None:
    table = written(tmp_path / "table.csv", "t_ns,length_m\n1,2\n")

    with pytest.raises(
        AnnotationError, match=r"table\.csv:1: expected columns t_ns,range_m, got t_ns,length_m"
    ):
        list(csv_rows(table, "t_ns,range_m"))
