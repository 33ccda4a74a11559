"""Messages of any error fit into one line."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.base import LogError, one_line


def test_line_ends_and_indents_become_one_space() -> None:
    assert one_line(ValueError("  two lines:\n\tthe second\r\n")) == "two lines: the second"


@pytest.mark.parametrize(("max_count", "kept"), [(None, "a bc d"), (4, "a bc"), (0, "")])
def test_the_length_counts_what_is_left(max_count: int | None, kept: str) -> None:
    assert one_line(LogError("a \n bc\n\nd"), max_count) == kept


@given(st.text(), st.integers(0, 50))
def test_a_line_is_one_line_and_its_beginning_the_whole_ones(said: str, max_count: int) -> None:
    whole = one_line(ValueError(said))

    assert len(whole.splitlines()) <= 1
    assert whole.split() == said.split()
    assert one_line(ValueError(said), max_count) == whole[:max_count]
