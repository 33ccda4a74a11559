"""Windows contain every sample once, in order of time, for any division of logs into blocks."""

from collections.abc import Iterator

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.base import EVERYTHING
from crosscue.replay.columns import Block
from crosscue.replay.ledger import Ledger
from crosscue.replay.signals.extractor import SampleExtractor
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.signals.plan import plan
from crosscue.replay.signals.windows import HORIZON_NS, SampleWindow, windows
from crosscue.replay.vehicle.vehicle import Vehicle
from support.memory_log import GYRO, WHEELS, MemoryLog, gyro_block, wheel_block

SECOND = 1_000_000_000


def _windows(logs: list[MemoryLog], ledgers: list[Ledger] | None = None) -> list[SampleWindow]:
    vehicle = Vehicle(version=1)
    planned = plan([(i, topic) for i, log in enumerate(logs) for topic in log.topics], vehicle)
    ledgers = ledgers or [Ledger(str(i)) for i in range(len(logs))]
    extractors = [SampleExtractor(planned, vehicle, i, ledger) for i, ledger in enumerate(ledgers)]
    return list(windows(logs, extractors, [EVERYTHING] * len(logs), planned))


def _chunks(t_ns: list[int], sizes: list[int]) -> list[list[int]]:
    chunks, at = [], 0
    for size in sizes:
        chunks.append(t_ns[at : at + size])
        at += size
    return [c for c in [*chunks, t_ns[at:]] if c]


_TIMES = st.lists(st.integers(0, 200 * SECOND), max_size=40, unique=True).map(sorted)
_SIZES = st.lists(st.integers(1, 9), max_size=12)


@given(wheels=_TIMES, gyro=_TIMES, wheel_sizes=_SIZES, gyro_sizes=_SIZES, apart=st.booleans())
def test_every_sample_is_returned_once_in_order(
    wheels: list[int], gyro: list[int], wheel_sizes: list[int], gyro_sizes: list[int], apart: bool
) -> None:
    one = [wheel_block(t, [x * 1e-9 for x in t]) for t in _chunks(wheels, wheel_sizes)]
    two = [gyro_block(t, [x * 1e-9 for x in t]) for t in _chunks(gyro, gyro_sizes)]
    if apart:
        logs = [MemoryLog((WHEELS,), one), MemoryLog((GYRO,), two)]
    else:
        both = sorted([*one, *two], key=lambda block: int(block.log_ns[0]))
        logs = [MemoryLog((WHEELS, GYRO), both)]

    found = _windows(logs)

    assert [w.start_ns for w in found] == sorted({t // SECOND * SECOND for t in [*wheels, *gyro]})
    for signal, times in ((Signal.WHEEL_SPEEDS, wheels), (Signal.YAW_RATE, gyro)):
        parts = [w.samples[signal] for w in found if signal in w.samples]
        found_times = [int(t) for part in parts for t in part.t_ns]
        assert found_times == times
    for window in found:
        for part in window.samples.values():
            assert ((part.t_ns >= window.start_ns) & (part.t_ns < window.end_ns)).all()


def test_silent_sensor_does_not_delay_other_sensors() -> None:
    seconds = range(0, 3 * HORIZON_NS // SECOND)
    blocks: list[Block] = [gyro_block([5], [0.0])]
    blocks += [wheel_block([s * SECOND], [1.0]) for s in seconds]
    read: list[int] = []

    log = MemoryLog((WHEELS, GYRO), _CountingBlocks(blocks, read))
    vehicle = Vehicle(version=1)
    planned = plan([(0, WHEELS), (0, GYRO)], vehicle)
    first = next(
        windows([log], [SampleExtractor(planned, vehicle, 0, Ledger(""))], [EVERYTHING], planned)
    )

    assert first.start_ns == 0
    assert len(read) <= HORIZON_NS // SECOND + 4


class _CountingBlocks(list[Block]):
    """Blocks that record the index of each block read."""

    def __init__(self, blocks: list[Block], read: list[int]) -> None:
        super().__init__(blocks)
        self._read = read

    def __iter__(self) -> Iterator[Block]:
        for i, block in enumerate(super().__iter__()):
            self._read.append(i)
            yield block


def test_rows_without_required_column_are_skipped_and_counted() -> None:
    block = Block("gyro", np.array([1], np.int64), wheel_block([1], [1.0]).rows)
    ledger = Ledger("odd")

    assert _windows([MemoryLog((GYRO,), [block])], [ledger]) == []
    assert ledger.topic("gyro").skipped == {"lacks a column its role needs": 1}
