"""Where the intersection is believed to be."""

from __future__ import annotations

from typing import NamedTuple


class Place(NamedTuple):
    """An intersection ahead, from the rear axle.

    Attributes:
        start_m: Its start.
        end_m: Its end.
        sd_m: Standard deviation of either.
    """

    start_m: float
    end_m: float
    sd_m: float
