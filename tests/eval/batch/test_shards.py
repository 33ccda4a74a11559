"""Shards of many drives: disjoint, complete, and stable by identity."""

from collections.abc import Mapping

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


def slurm_array(number: int, first: int, last: int, step: int, count: int) -> dict[str, str]:
    values = {"ID": number, "MIN": first, "MAX": last, "STEP": step, "COUNT": count}
    return {f"SLURM_ARRAY_TASK_{name}": str(value) for name, value in values.items()}


@pytest.mark.parametrize(
    ("text", "variables", "shard"),
    [
        ("2/4", {}, Shard(2, 4)),
        ("1/1", {"RANK": "7", "WORLD_SIZE": "8"}, Shard(1, 1)),
        ("auto", {"RANK": "0", "WORLD_SIZE": "3"}, Shard(1, 3)),
        ("auto", slurm_array(8, 1, 8, 1, 8), Shard(8, 8)),
        ("auto", slurm_array(0, 0, 3, 1, 4), Shard(1, 4)),
        ("auto", slurm_array(9, 1, 9, 4, 3), Shard(3, 3)),
        ("auto", slurm_array(5, 5, 5, 1, 1), Shard(1, 1)),
        ("auto", {"SLURM_ARRAY_TASK_ID": "2", "SLURM_ARRAY_TASK_COUNT": "4"}, Shard(3, 4)),
    ],
)
def test_shard_option_is_read(text: str, variables: Mapping[str, str], shard: Shard) -> None:
    assert read_shard(text, variables) == shard
    assert read_shard(str(shard), {}) == shard


@pytest.mark.parametrize(
    ("text", "variables", "message"),
    [
        ("0/4", {}, "expected i/n with i from 1 to n"),
        ("5/4", {}, "expected i/n with i from 1 to n"),
        ("1/0", {}, "expected i/n"),
        ("two", {}, "expected i/n"),
        ("auto", {}, "neither SLURM_ARRAY_TASK_ID nor RANK and WORLD_SIZE is set"),
        ("auto", {"RANK": "1"}, "neither"),
        ("auto", {"RANK": "3", "WORLD_SIZE": "3"}, "outside its own range"),
        ("auto", {"RANK": "x", "WORLD_SIZE": "3"}, "RANK='x': expected a whole number"),
        ("auto", slurm_array(3, 1, 7, 1, 3), "expected array tasks in equal steps"),
        ("auto", slurm_array(1, 1, 7, 1, 3), "expected array tasks in equal steps"),
        ("auto", {**slurm_array(1, 1, 2, 1, 2), "RANK": "0", "WORLD_SIZE": "2"}, "both"),
    ],
)
def test_invalid_shard_option_is_refused(
    text: str, variables: Mapping[str, str], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        read_shard(text, variables)
