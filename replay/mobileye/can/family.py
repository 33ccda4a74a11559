"""Determine which of two families of devices sends 0x700, whose bits they define differently.

The family is decided by a set bit that only one family defines. If bits of both families are set in
one log, it is undecided.
"""

from typing import Final

import numpy as np

from crosscue.replay.mobileye.bits import Words
from crosscue.replay.mobileye.layout import UNKNOWN, Variant, variant_number
from crosscue.replay.mobileye.settings import Family


def _mask(*bits: int) -> np.uint64:
    return np.uint64(sum(1 << b for b in bits))


# Bits that only the extended family defines: sound suppressed, left and right crossing.
ONLY_EXTENDED: Final = _mask(7, 36, 37)
# Bits that only the TSR family defines: zero speed, high beam, error (inverted, so usually set),
# reminders, TSR, repeatable headway.
ONLY_TSR: Final = _mask(13, 14, 15, *range(24, 32), *range(43, 51), 58)


class FamilyEvidence:
    """Evidence of the family from the frames so far."""

    def __init__(self, bus: str, family: Family) -> None:
        self._bus = bus
        self._set = variant_number(family)
        self._extended = False
        self._tsr = False
        self._undecided = 0

    def __call__(self, words: Words) -> Variant:
        """Return the family of each frame, from the evidence of all frames up to it."""
        if self._set != UNKNOWN:
            return np.full(len(words), self._set, dtype=np.int8)
        extended = np.logical_or.accumulate(words & ONLY_EXTENDED != 0) | self._extended
        tsr = np.logical_or.accumulate(words & ONLY_TSR != 0) | self._tsr
        if len(words):
            self._extended, self._tsr = bool(extended[-1]), bool(tsr[-1])
        family = np.where(extended, variant_number("extended"), variant_number("tsr"))
        family = np.where(extended == tsr, UNKNOWN, family)
        self._undecided += int((extended == tsr).sum())
        return family.astype(np.int8)

    def notices(self) -> list[str]:
        """Return notices for the end of the log."""
        if not self._undecided:
            return []
        why = "has bits of both" if self._extended and self._tsr else "at first has bits of neither"
        return [
            f"{self._bus}: 0x700 {why} families of devices; in {self._undecided} frames the bits "
            "that they define differently are missing; set the family (extended or tsr)"
        ]
