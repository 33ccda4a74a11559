"""Drives in folders: cameras, and numeric streams that are kept in memory."""

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple, Protocol

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import BLOCK_ROWS, Block, Int64s, Rows, Topic
from crosscue.replay.files.closing import Closing
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.readers.images.files import PictureFiles
from crosscue.replay.seal.touched import Touched

NO_PARTNER: Final = "a row without its time, or a time without its row"


class Loss(NamedTuple):
    """Rows that could not be parsed; ``rows`` is None if their number is unknown."""

    reason: str
    rows: int | None
    detail: str


@dataclass(frozen=True, slots=True, eq=False)
class HeldRows:
    """The rows of a topic in order of time.

    Attributes:
        topic: The topic; its ``declared`` count includes dropped rows.
        t_ns: Shape (N,), int64: times.
        rows: N rows.
        losses: Losses found when the rows were read.
    """

    topic: Topic
    t_ns: Int64s
    rows: Rows
    losses: tuple[Loss, ...] = ()

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The one topic."""
        return (self.topic,)

    def read(self, ledger: Ledger, selection: Selection) -> Iterator[Block]:
        """Yield the selected rows and account for them."""
        name = self.topic.name
        ledger.declare(name, self.topic.declared)
        kept = selection.account(name, self.t_ns, ledger)
        for loss in self.losses:
            ledger.drop(name, *loss)
        if len(self.t_ns) and (kept is None or kept.any()):
            whole = Block(name, self.t_ns, self.rows)
            block = whole if kept is None else whole.take(kept)
            for first in range(0, len(block), BLOCK_ROWS):
                yield block.take(slice(first, first + BLOCK_ROWS))
        if not selection.is_timed:
            ledger.settle(name, NO_PARTNER)

    def report_missing(self, ledger: Ledger) -> None:
        """Report rows without a time, times without a row, and damage; see ``KnowsItsEnd``."""
        lost = sum(loss.rows or 0 for loss in self.losses)
        for loss in self.losses:
            ledger.drop(self.topic.name, *loss)
        missing = (self.topic.declared or 0) - len(self.t_ns) - lost
        ledger.drop(self.topic.name, NO_PARTNER, max(missing, 0))


class Numbers(Protocol):
    """Numeric streams of a drive."""

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Topics of the streams."""

    def read(self, ledger: Ledger, selection: Selection) -> Iterator[Block]:
        """Yield the selected rows and account for them."""

    def report_missing(self, ledger: Ledger) -> None:
        """Report missing rows; see ``KnowsItsEnd``."""


class CameraDrive(Closing):
    """A drive in a folder as a ``Log``; subclasses add the ``format`` and the intrinsics."""

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
        """Create a drive.

        Args:
            path: Folder of the drive.
            cameras: Image files of the cameras.
            numbers: Numeric streams.
            limits: Maximum sizes of its files.
            touched: Record of the files read, for a seal.
            unreadable: Parts that could not be opened, as arguments of ``Ledger.drop``.
            notices: Remarks on the drive, one sentence each.
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
        """Topics of the cameras, then of the numeric streams."""
        return (
            *(camera.topic for camera in self._cameras),
            *(topic for numbers in self._numbers for topic in numbers.topics),
        )

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Yield all streams, merged by each block's first time; see ``Log.read``."""
        for loss in self._unreadable:
            ledger.drop(*loss)
        for sentence in self._notices:
            ledger.notice(sentence)
        streams = [camera.read(ledger, selection, self._limits) for camera in self._cameras]
        streams += [numbers.read(ledger, selection) for numbers in self._numbers]
        yield from heapq.merge(*streams, key=lambda block: int(block.log_ns[0]))

    def report_missing(self, ledger: Ledger) -> None:
        """Report images and rows without a time, and times without them; see ``KnowsItsEnd``."""
        for loss in self._unreadable:
            ledger.drop(*loss)
        for camera in self._cameras:
            camera.report_missing(ledger)
        for numbers in self._numbers:
            numbers.report_missing(ledger)
