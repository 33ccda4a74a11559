"""The message of any error is returned on one line."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.errors import LogError, one_line


def test_line_ends_and_indents_collapse_to_one_space() -> None:
    assert one_line(ValueError("  two lines:\n\tthe second\r\n")) == "two lines: the second"


@pytest.mark.parametrize(("max_count", "kept"), [(None, "a bc d"), (4, "a bc"), (0, "")])
def test_message_is_truncated_after_collapsing(max_count: int | None, kept: str) -> None:
    assert one_line(LogError("a \n bc\n\nd"), max_count) == kept


@given(st.text(), st.integers(0, 50))
def test_truncated_message_is_prefix_of_one_line_message(content: str, max_count: int) -> None:
    collapsed = one_line(ValueError(content))

    assert len(collapsed.splitlines()) <= 1
    assert collapsed.split() == content.split()
    assert one_line(ValueError(content), max_count) == collapsed[:max_count]
