"""Shards of many drives: disjoint, complete, and stable by identity."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.eval.batch.drive_list import Shard, read_shard
from crosscue.replay.errors import UsageError

IDENTITIES = st.sets(st.text("0123456789abcdef", min_size=8, max_size=8), max_size=40)


@given(IDENTITIES, st.integers(1, 9))
def test_every_drive_is_in_exactly_one_shard(identities: set[str], count: int) -> None:
    shards = [Shard(number, count) for number in range(1, count + 1)]

    for identity in identities:
        assert sum(shard.holds(identity) for shard in shards) == 1


def test_shard_option_is_read() -> None:
    assert read_shard("2/4") == Shard(2, 4)
    assert read_shard(str(Shard(2, 4))) == Shard(2, 4)


@pytest.mark.parametrize("text", ["0/4", "5/4", "1/0", "two"])
def test_invalid_shard_option_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="expected i/n with i from 1 to n"):
        read_shard(text)
