"""Detection of missing rows by the message numbers that a recorder writes before every row.

A recorder numbers its rows 1, 2, 3, ..., so a missing number is a missing row. Rows may be out of
order, so a later row with a missing number closes the gap again. A row is damaged if its number
does not follow its predecessor's and its two neighbors' numbers leave exactly one number between
them.
"""

from typing import Final

import numpy as np

from crosscue.replay.columns import Int64s
from crosscue.replay.ledger import Ledger

from .digits import Bools

MISSING: Final = "message numbers missing"
MISFIT: Final = "message number does not fit between its neighbors"
GO_BACK: Final = "message numbers repeat or go back"
# Number of latest gaps that a later row may close; only nearby rows are out of order.
_GAPS_KEPT: Final = 8
_PLACES_KEPT: Final = 5


class MessageNumbers:
    """The message numbers of one pass over a log, in stored order."""

    def __init__(self) -> None:
        """Start without any rows."""
        self._last, self._highest = 0, 0
        self._gaps: list[tuple[int, int]] = []
        self._missing = self._backward = self._misfits = self._damaged = 0
        self._is_fresh = True
        self._places: list[str] = []
        self._back_places: list[str] = []
        self._misfit_places: list[str] = []

    def begin(self) -> None:
        """Start a new recording, whose numbers restart."""
        self._settle_gaps()
        self._last = self._highest = self._damaged = 0
        self._is_fresh = True

    def misfits(self, number: Int64s, following: int) -> Bools:
        """Return a mask of the rows whose number contradicts their neighbors, shape (N,).

        Args:
            number: Shape (N,): numbers of consecutive rows.
            following: Number of the row after them; -1 if unknown.
        """
        before = np.concatenate(([self._last], number[:-1]))
        after = np.append(number[1:], following)
        found: Bools = (number != before + 1) & (after == before + 2)
        return found

    def misfit(self, number: int, line: int) -> None:
        """Record a row that is dropped because of its number."""
        self._misfits += 1
        _note(self._misfit_places, f"line {line}: {number}")

    def follow(self, number: Int64s, line: Int64s, damaged: Int64s, first_line: int) -> None:
        """Process the numbers of consecutive valid rows.

        Args:
            number: Shape (N,): the numbers.
            line: Shape (N,), ascending: their lines, counted from the chunk's first.
            damaged: Unreadable lines, ascending, which are reported separately. Each may be the
                missing row of a gap, which is then not reported again.
            first_line: Number of the chunk's first line in the file.
        """
        if not len(number):
            self._damaged += len(damaged)
            return
        starts = np.concatenate(([0], np.flatnonzero(np.diff(number) != 1) + 1))
        stops = np.append(starts[1:], len(number))
        # An unreadable line within a run had no number, because the run has no gap.
        bad = np.searchsorted(damaged, line[starts])
        bad[1:] -= np.searchsorted(damaged, line[starts[1:] - 1])
        bad[0] += self._damaged
        for start, stop, count in zip(starts.tolist(), stops.tolist(), bad.tolist(), strict=True):
            self._run(
                int(number[start]), int(number[stop - 1]), first_line + int(line[start]), count
            )
        self._damaged = len(damaged) - int(np.searchsorted(damaged, line[-1]))

    def settle(self, ledger: Ledger) -> None:
        """Report the missing rows, after the complete file has been read."""
        self._settle_gaps()
        ledger.drop("", MISFIT, self._misfits, _listed(self._misfit_places, self._misfits))
        more = f"first {_PLACES_KEPT} gaps: " if len(self._places) == _PLACES_KEPT else ""
        ledger.drop("", MISSING, self._missing, more + "; ".join(self._places))
        if self._backward:
            detail = _listed(self._back_places, self._backward)
            ledger.drop("", GO_BACK, None, f"{self._backward} times: {detail}")

    def _run(self, first: int, last: int, line: int, damaged: int) -> None:
        """Process rows ``first`` to ``last`` without a gap, after ``damaged`` unreadable lines."""
        if self._is_fresh and first == 0:  # some writers count from zero
            self._highest = -1
        self._is_fresh = False
        if first > self._highest:
            if first > self._highest + 1:
                self._gap(self._highest + 1, first, line, damaged)
        elif not self._fill(first, last):
            self._backward += 1
            _note(self._back_places, f"line {line}: {first} after {self._last}")
            # A new recording starts, or a part is repeated: the rows between are unknown.
            self._settle_gaps()
            self._highest = last
        self._highest = max(self._highest, last)
        self._last = last

    def _gap(self, start: int, stop: int, line: int, damaged: int) -> None:
        """Record that the numbers ``start`` to ``stop - 1`` are missing."""
        start += min(damaged, stop - start)
        if start == stop:
            return
        self._gaps.append((start, stop))
        spelled = f"{start} to {stop - 1}" if stop - start > 1 else f"{start}"
        _note(self._places, f"line {line}: {spelled}")
        if len(self._gaps) > _GAPS_KEPT:
            start, stop = self._gaps.pop(0)
            self._missing += stop - start

    def _fill(self, first: int, last: int) -> bool:
        """Close the gap that contains the run; return False if one of its numbers is repeated."""
        for k, (start, stop) in enumerate(self._gaps):
            if start <= first < stop:
                rest = [(start, first), (last + 1, stop)]
                self._gaps[k : k + 1] = [(a, b) for a, b in rest if a < b]
                return last < stop
        return False

    def _settle_gaps(self) -> None:
        self._missing += sum(stop - start for start, stop in self._gaps)
        self._gaps = []


def _note(places: list[str], place: str) -> None:
    if len(places) < _PLACES_KEPT:
        places.append(place)


def _listed(places: list[str], count: int) -> str:
    more = f" and {count - len(places)} more" if count > len(places) else ""
    return "; ".join(places) + more
