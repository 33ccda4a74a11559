"""A stream of numbers held in memory, for data sets whose drives have some thousand rows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

from crosscue.replay.base import (
    NOT_ASKED_TIME,
    NOT_ASKED_TOPIC,
    Block,
    Int64s,
    Ledger,
    Selection,
    Table,
    Topic,
)
from crosscue.replay.readers.timed_files import is_inside

NO_PARTNER: Final = "a row without its time, or a time without its row"


class Loss(NamedTuple):
    """Rows that could not be understood; ``rows`` is None where nobody can know how many."""

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
            wanted = is_inside(self.t_ns, selection)
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
