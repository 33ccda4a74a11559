"""A drafted vehicle file names topics as the log does, whatever characters they have."""

import tomllib

from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.vehicle.drafting.text import _quoted


@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_a_quoted_name_reads_back_and_hides_nothing(name: str) -> None:
    text = _quoted(name)

    assert tomllib.loads(f"name = {text}") == {"name": name}
    assert text.isprintable()
