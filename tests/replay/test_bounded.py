"""Files of settings and annotations are read completely or refused, even endless ones."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.datasets.truth import truth
from crosscue.detectors.catalog.card import read_card
from crosscue.eval.fit.ranges.fit import range_pairs
from crosscue.eval.scoring.gates import load_gates
from crosscue.replay.errors import CrosscueError
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.vehicle import vehicle

ENDLESS = Path("/dev/zero")


@given(content=st.binary(max_size=40), max_count=st.integers(0, 40))
def test_file_over_limit_is_not_read(content: bytes, max_count: int) -> None:
    with tempfile.NamedTemporaryFile() as file:
        file.write(content)
        file.flush()

        assert read_at_most(Path(file.name), max_count) == (
            content if len(content) <= max_count else None
        )


@pytest.mark.skipif(not ENDLESS.exists(), reason="no /dev/zero here")
@pytest.mark.parametrize(
    "read", [vehicle.load, read_card, load_gates, truth.read_truth, range_pairs]
)
def test_endless_file_is_refused(read: Callable[[Path], object]) -> None:
    with pytest.raises(CrosscueError, match=r"/dev/zero: over \d+ MiB"):
        read(ENDLESS)
