"""Colours with the same meaning in pictures, pages and recordings, as red, green, blue.

They are legible on white, on black and on photographs.
"""

from collections.abc import Mapping
from typing import Final

Colour = tuple[int, int, int]

# What is true: labels, the true track, true ranges.
TRUTH: Final[Colour] = (35, 160, 65)
# What was found: detections, the estimated track.
FOUND: Final[Colour] = (45, 135, 235)
# Detections that are too uncertain to count, and other asides.
QUIET: Final[Colour] = (130, 130, 130)
FAINT: Final[Colour] = (165, 165, 165)
WRONG: Final[Colour] = (220, 50, 50)
SIGMA: Final[Colour] = (255, 150, 60)
ROAD: Final[Colour] = (40, 210, 190)
LANE: Final[Colour] = (140, 100, 220)
LANDMARK: Final[Colour] = (170, 70, 190)
# Start and end of the intersection.
START: Final[Colour] = (225, 60, 60)
END: Final[Colour] = (215, 150, 0)
FEATURES: Final[Mapping[str, Colour]] = {
    "intersection": (155, 95, 220),
    "left": (20, 150, 160),
    "right": (225, 110, 30),
    "straight": (215, 75, 150),
}
# User-defined features, in turn.
OTHERS: Final[tuple[Colour, ...]] = ((175, 130, 40), (140, 160, 60), (120, 130, 170))


def of_feature(name: str, number: int = 0) -> Colour:
    """Return the colour of a feature; user-defined ones get the remaining colours in turn."""
    return FEATURES.get(name, OTHERS[number % len(OTHERS)])


def bgr(colour: Colour) -> Colour:
    """Return a colour in the order of OpenCV."""
    return colour[2], colour[1], colour[0]


def css(colour: Colour, lighter: float = 0.0) -> str:
    """Return a colour for a style sheet, mixed with a fraction of white for dark pages."""
    red, green, blue = (round(part + lighter * (255 - part)) for part in colour)
    return f"#{red:02x}{green:02x}{blue:02x}"
