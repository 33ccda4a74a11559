"""Message numbers that a writer puts before every row: which of them no row carries.

A recorder numbers its rows 1, 2, 3, ... so a number that is missing is a row that is missing. Rows
may stand out of order, so a gap is closed again by a row that brings its number later. A row whose
number differs while its two neighbors' numbers leave room for exactly that row is a damaged row.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from crosscue.replay.base import Int64s, Ledger

from .digits import Bools

MISSING: Final = "message numbers missing"
MISFIT: Final = "message number does not fit between its neighbors"
GO_BACK: Final = "message numbers repeat or go back"
_GAPS_KEPT: Final = 8
"""Latest gaps that a later row may still close; rows change places with near ones only."""
_PLACES_KEPT: Final = 5


class MessageNumbers:
    """The message numbers of one pass over a log, in stored order."""

    def __init__(self) -> None:
        """Nothing met yet."""
        self._last, self._highest = 0, 0
        self._gaps: list[tuple[int, int]] = []
        self._missing = self._backward = self._misfits = self._damaged = 0
        self._is_fresh = True
        self._places: list[str] = []
        self._back_places: list[str] = []
        self._misfit_places: list[str] = []

    def begin(self) -> None:
        """A header begins a recording whose numbers start again."""
        self._settle_gaps()
        self._last = self._highest = self._damaged = 0
        self._is_fresh = True

    def misfits(self, number: Int64s, following: int) -> Bools:
        """Which rows carry a number that their neighbors contradict, shape (N,).

        Args:
            number: Shape (N,): of consecutive rows.
            following: Number of the row after them; -1 if not known.
        """
        before = np.concatenate(([self._last], number[:-1]))
        after = np.append(number[1:], following)
        found: Bools = (number != before + 1) & (after == before + 2)
        return found

    def misfit(self, number: int, line: int) -> None:
        """A row that is not handed on, because of its number."""
        self._misfits += 1
        _note(self._misfit_places, f"line {line}: {number}")

    def follow(self, number: Int64s, line: Int64s, damaged: Int64s, first_line: int) -> None:
        """Take the numbers of consecutive good rows.

        Args:
            number: Shape (N,).
            line: Shape (N,), ascending: their lines, counted from the chunk's first.
            damaged: Lines that could not be read, ascending; reported on their own. Each may be the
                row that a gap lacks, which is then not reported a second time.
            first_line: Number of the chunk's first line in the file.
        """
        if not len(number):
            self._damaged += len(damaged)
            return
        starts = np.concatenate(([0], np.flatnonzero(np.diff(number) != 1) + 1))
        stops = np.append(starts[1:], len(number))
        # What was unreadable within a run carried no number: the run lacks none.
        bad = np.searchsorted(damaged, line[starts])
        bad[1:] -= np.searchsorted(damaged, line[starts[1:] - 1])
        bad[0] += self._damaged
        for start, stop, count in zip(starts.tolist(), stops.tolist(), bad.tolist(), strict=True):
            self._run(
                int(number[start]), int(number[stop - 1]), first_line + int(line[start]), count
            )
        self._damaged = len(damaged) - int(np.searchsorted(damaged, line[-1]))

    def settle(self, ledger: Ledger) -> None:
        """Report what is missing, once everything is read."""
        self._settle_gaps()
        ledger.drop("", MISFIT, self._misfits, _listed(self._misfit_places, self._misfits))
        more = f"first {_PLACES_KEPT} gaps: " if len(self._places) == _PLACES_KEPT else ""
        ledger.drop("", MISSING, self._missing, more + "; ".join(self._places))
        if self._backward:
            detail = _listed(self._back_places, self._backward)
            ledger.drop("", GO_BACK, None, f"{self._backward} times: {detail}")

    def _run(self, first: int, last: int, line: int, damaged: int) -> None:
        """Rows numbered ``first`` to ``last`` without a gap, after ``damaged`` unreadable ones."""
        if self._is_fresh and first == 0:  # some writers count from zero
            self._highest = -1
        self._is_fresh = False
        if first > self._highest:
            if first > self._highest + 1:
                self._gap(self._highest + 1, first, line, damaged)
        elif not self._fill(first, last):
            self._backward += 1
            _note(self._back_places, f"line {line}: {first} after {self._last}")
            # Another recording begins, or a part comes again: what lies between is unknown.
            self._settle_gaps()
            self._highest = last
        self._highest = max(self._highest, last)
        self._last = last

    def _gap(self, start: int, stop: int, line: int, damaged: int) -> None:
        """No row was met with the numbers ``start`` to ``stop - 1``."""
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
        """Close the gap that the run is in; False where a number of it was met before."""
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
