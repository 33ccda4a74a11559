"""Drives of data sets: cameras beside streams of numbers, which are held in memory where short."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple, Protocol

from crosscue.replay.base import (
    EVERYTHING,
    NOT_ASKED_TIME,
    NOT_ASKED_TOPIC,
    Block,
    Closing,
    Int64s,
    Ledger,
    Limits,
    Selection,
    Table,
    Topic,
)
from crosscue.replay.readers.images.files import PictureFiles
from crosscue.replay.seal.touched import Touched

NO_PARTNER: Final = "a row without its time, or a time without its row"


class Loss(NamedTuple):
    """Rows that could not be understood; ``rows`` is None where it cannot be known how many."""

    reason: str
    rows: int | None
    detail: str


@dataclass(frozen=True, slots=True, eq=False)
class HeldRows:
    """One topic's rows in order of time.

    Attributes:
        topic: Its ``declared`` counts lost rows, too.
        t_ns: Shape (N,), int64.
        table: N rows.
        losses: What was found damaged when they were read.
    """

    topic: Topic
    t_ns: Int64s
    table: Table
    losses: tuple[Loss, ...] = ()

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The one topic."""
        return (self.topic,)

    def read(self, ledger: Ledger, selection: Selection) -> Iterator[Block]:
        """The rows asked for, with their account."""
        name, n = self.topic.name, len(self.t_ns)
        ledger.declare(name, self.topic.declared)
        ledger.find(name, n)
        for loss in self.losses:
            ledger.drop(name, *loss)
        if not selection.wants(name):
            ledger.skip(name, NOT_ASKED_TOPIC, n)
        else:
            wanted = selection.inside(self.t_ns)
            ledger.skip(name, NOT_ASKED_TIME, n - int(wanted.sum()))
            if wanted.any():
                yield Block(name, self.t_ns, self.table).take(wanted)
        if selection.start_ns is None and selection.end_ns is None:
            ledger.settle(name, NO_PARTNER)

    def report_missing(self, ledger: Ledger) -> None:
        """Rows without a time, times without a row, and damaged ones; see ``KnowsItsEnd``."""
        lost = sum(loss.rows or 0 for loss in self.losses)
        for loss in self.losses:
            ledger.drop(self.topic.name, *loss)
        missing = (self.topic.declared or 0) - len(self.t_ns) - lost
        ledger.drop(self.topic.name, NO_PARTNER, max(missing, 0))


class Numbers(Protocol):
    """Streams of numbers beside a drive's cameras."""

    @property
    def topics(self) -> tuple[Topic, ...]:
        """What they are called."""
        ...

    def read(self, ledger: Ledger, selection: Selection) -> Iterator[Block]:
        """The rows asked for, with their account."""
        ...

    def report_missing(self, ledger: Ledger) -> None:
        """See ``KnowsItsEnd``."""
        ...


class CameraDrive(Closing):
    """A drive of a data set as a ``Log``; a data set adds its ``format`` and its intrinsics."""

    def __init__(
        self,
        path: Path,
        cameras: Sequence[PictureFiles],
        numbers: Sequence[Numbers],
        limits: Limits,
        touched: Touched,
        *,
        unreadable: Sequence[tuple[str, str, int | None, str]] = (),
        notices: Sequence[str] = (),
    ) -> None:
        """Put a drive together.

        Args:
            path: Its folder.
            cameras: Their pictures.
            numbers: Beside them.
            limits: That its files are read with.
            touched: Which files are read, for a seal.
            unreadable: What could not be opened, as arguments for ``Ledger.drop``.
            notices: What is odd about it, a sentence each.
        """
        self.path: Final = path
        self.touched: Final = touched
        self._cameras: Final = tuple(cameras)
        self._numbers: Final = tuple(numbers)
        self._limits: Final = limits
        self._unreadable: Final = tuple(unreadable)
        self._notices: Final = tuple(notices)

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Cameras, then numbers."""
        return (
            *(camera.topic for camera in self._cameras),
            *(topic for numbers in self._numbers for topic in numbers.topics),
        )

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """All streams side by side, in order of each block's first time; see ``Log.read``."""
        for loss in self._unreadable:
            ledger.drop(*loss)
        for sentence in self._notices:
            ledger.notice(sentence)
        streams = [camera.read(ledger, selection, self._limits) for camera in self._cameras]
        streams += [numbers.read(ledger, selection) for numbers in self._numbers]
        yield from heapq.merge(*streams, key=lambda block: int(block.log_ns[0]))

    def report_missing(self, ledger: Ledger) -> None:
        """Pictures and rows without a time, times without them; see ``KnowsItsEnd``."""
        for loss in self._unreadable:
            ledger.drop(*loss)
        for camera in self._cameras:
            camera.report_missing(ledger)
        for numbers in self._numbers:
            numbers.report_missing(ledger)

    def close(self) -> None:
        """Nothing is held open."""
