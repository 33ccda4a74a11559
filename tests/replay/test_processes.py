"""Parallel work returns the same results in the same order for any number of processes."""

from __future__ import annotations

import os
import time

import pytest

from crosscue.replay.processes import in_processes


def slow_square(number: int) -> tuple[int, int]:
    """Return the square of a number and the process id; small numbers take longest."""
    time.sleep(0.05 * max(0, 3 - number))
    return number * number, os.getpid()


def fail_at_two(number: int) -> int:
    if number == 2:
        raise ValueError("two")
    return number


@pytest.mark.slow
def test_results_of_other_processes_are_ordered() -> None:
    found = list(in_processes(slow_square, range(6), 2))

    assert [square for square, _ in found] == [0, 1, 4, 9, 16, 25]
    assert os.getpid() not in {process for _, process in found}


@pytest.mark.parametrize(("items", "workers"), [([1, 2, 3], 1), ([4], 8), ([], 8)])
def test_one_worker_or_item_runs_in_this_process(items: list[int], workers: int) -> None:
    found = list(in_processes(slow_square, items, workers))

    assert [square for square, _ in found] == [number * number for number in items]
    assert {process for _, process in found} <= {os.getpid()}


@pytest.mark.parametrize("workers", [1, 2])
def test_failure_is_raised_after_earlier_results(workers: int) -> None:
    found = in_processes(fail_at_two, range(4), workers)

    assert [next(found), next(found)] == [0, 1]
    with pytest.raises(ValueError, match="two"):
        next(found)
