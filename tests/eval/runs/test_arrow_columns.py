"""Columns of a run's tables: what ``pa.array`` makes of the same values."""

from __future__ import annotations

import math

import numpy as np
import pyarrow as pa
import pytest

from crosscue.eval.runs.tables.parquet import arrow_column

KINDS = pa.dictionary(pa.int8(), pa.string())


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        ([1, None, 3], pa.int64()),
        (range(4), pa.int64()),
        (np.arange(10)[::2], pa.int64()),
        (np.arange(5, dtype=np.uint8), pa.int32()),
        (np.arange(3), pa.float64()),
        ([1.0, None, math.inf], pa.float64()),
        (np.array([1.5, -0.0], np.float32), pa.float64()),
        ([True, None, False], pa.bool_()),
        (np.arange(19) % 3 == 0, pa.bool_()),
        (("a", None, "", "größer"), pa.string()),
        (np.array(["a", "bb"]), pa.string()),
        (["x", "y", "x"], KINDS),
        ([[1.0], None, []], pa.list_(pa.float64())),
        ([b"a", None], pa.binary()),
        *(([], kind) for kind in (pa.int64(), pa.float64(), pa.bool_(), pa.string(), KINDS)),
    ],
    ids=str,
)
def test_column_equals_that_of_arrow(values: object, kind: pa.DataType) -> None:
    column = arrow_column(values, kind)

    column.validate(full=True)
    assert column.equals(pa.array(values, kind))


def test_missing_number_is_not_nan() -> None:
    column = arrow_column([math.nan, None], pa.float64())

    assert column.is_null().to_pylist() == [False, True]


@pytest.mark.parametrize(
    ("values", "kind"),
    [([1.5], pa.int64()), (["a"], pa.float64()), ([1], pa.bool_()), ([2**70], pa.int64())],
    ids=str,
)
def test_value_of_another_type_is_refused(values: object, kind: pa.DataType) -> None:
    with pytest.raises((TypeError, ValueError, OverflowError)):
        arrow_column(values, kind)
