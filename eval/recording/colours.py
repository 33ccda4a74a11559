"""Colours with the same meaning in every view of a recording, for light and dark backgrounds."""

from __future__ import annotations

from typing import Final

from crosscue.replay.vehicle.cue_spec import FEATURE_COLOURS

from .columns import Colour

ESTIMATE: Final[Colour] = (50, 130, 230)
TRUTH: Final[Colour] = (40, 160, 70)
ELLIPSE: Final[Colour] = (255, 150, 60)
START: Final[Colour] = (225, 60, 60)
END: Final[Colour] = (220, 150, 0)
QUIET: Final[Colour] = (125, 125, 125)
FAINT: Final[Colour] = (165, 165, 165)
LANDMARK: Final[Colour] = (170, 70, 190)
VEHICLE: Final[Colour] = (50, 130, 230)
LANE: Final[Colour] = (140, 100, 220)
OTHERS: Final[tuple[Colour, ...]] = ((200, 120, 255), (250, 220, 90), (90, 220, 220))


def of_feature(name: str, number: int) -> Colour:
    """Return the colour of a feature; user-defined ones get the remaining colours in turn."""
    return FEATURE_COLOURS.get(name, OTHERS[number % len(OTHERS)])
