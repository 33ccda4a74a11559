"""Wrong arguments are refused with the argument's name, what is expected and what was found."""

import math
from collections.abc import Callable
from typing import Final

import numpy as np
import pytest

from crosscue.datasets.geodesy import ecef_to_geodetic
from crosscue.eval.scoring.consistency import mean_band
from crosscue.localization.angles import circular_mean
from crosscue.localization.compass import CompassSettings, heading
from crosscue.localization.landmarks.database import LandmarkPosition
from crosscue.localization.landmarks.features import Keypoints
from crosscue.localization.navigation import choose_option

MIRROR: Final = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
STRETCH: Final = ((2.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
EMPTY: Final = np.empty(0)
CASES: Final[dict[str, Callable[[], object]]] = {
    "got a reflection": lambda: CompassSettings(mounting_rotation=MIRROR),
    "mounting_rotation: expected a rotation": lambda: CompassSettings(mounting_rotation=STRETCH),
    "soft_iron: expected determinant > 0": lambda: CompassSettings(soft_iron=MIRROR),
    "declination_rad: expected finite": lambda: CompassSettings(declination_rad=math.nan),
    r"field_t: expected \(4, 3\), got \(4, 2\)": lambda: heading(
        np.zeros((4, 2)), CompassSettings()
    ),
    "cancel out": lambda: circular_mean(np.array([0.0, math.pi])),
    "at least one angle": lambda: circular_mean(EMPTY),
    "at least one option": lambda: choose_option(EMPTY, EMPTY, EMPTY),
    "name, source: expected up to": lambda: LandmarkPosition("", np.zeros(2), np.eye(2)),
    "expected Unicode": lambda: LandmarkPosition("\udcff", np.zeros(2), np.eye(2)),
    r"points_px: expected \(3, 2\)": lambda: Keypoints(
        1, 1, np.zeros((2, 2), np.float32), np.zeros((3, 32), np.uint8)
    ),
    "dimensions: expected >= 1": lambda: mean_band(0, 10),
    r"xyz_m: expected \(N, 3\)": lambda: ecef_to_geodetic(np.zeros((2, 2))),
}


@pytest.mark.parametrize("message", CASES)
def test_wrong_argument_is_refused_by_name(message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CASES[message]()
