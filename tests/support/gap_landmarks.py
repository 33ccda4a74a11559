"""Landmarks along ``gap_drive``, whose pictures say by their grey level where they were made."""

from __future__ import annotations

from typing import Final

import numpy as np

from crosscue.localization.landmarks.features import CameraGeometry, Features
from crosscue.replay.base import Bytes

from .gap_drive import ROW, SECOND, SPEED_MPS
from .landmark_drive import NearnessMatcher, there

STEP_M: Final = SPEED_MPS * ROW / SECOND
"""From row to row."""


class PlaceByNumber(NearnessMatcher):
    """Takes a picture for the place where it was made, which its grey level says."""

    def describe(self, grey: Bytes, /) -> Features:
        """The place."""
        return there(np.array([STEP_M * float(np.median(grey)), 0.0]))


def matcher(_camera: CameraGeometry) -> PlaceByNumber:
    """A factory, as the vehicle file names it."""
    return PlaceByNumber(5.0)
