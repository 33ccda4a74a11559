"""The page and the tables of the study of layouts."""

import math

import pytest

from crosscue.eval.scoring.intervals import Mean
from crosscue.eval.studies.layouts.report import verdict


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (-0.2, -0.1, "better"),
        (0.1, 0.2, "worse"),
        (-0.1, 0.2, "undecided"),
        (math.nan, math.nan, "undecided"),
    ],
)
def test_verdict_requires_interval_without_zero(low: float, high: float, expected: str) -> None:
    assert verdict(Mean((low + high) / 2.0, low, high, 10, 5)) == expected
