"""Tests of the simulator's filter: NEES and NIS are within their chi-square bands.

The wheel encoders' resolution is too fine to be a source of error here, because the filter ignores
it. docs/studies.md reports where the filter is overconfident, and by how much.
"""

import math

import numpy as np
import pytest

from crosscue.eval.scoring.consistency import mean_band
from crosscue.localization.angles import wrap_all
from crosscue.localization.town.drive import DriveResult, Traced, drive_many, drive_traced
from crosscue.localization.town.settings import Sensors, TownDrive
from crosscue.replay.columns import Floats
from support.arc_consistency import nees_along_the_arc

NEES = DriveResult._fields.index("nees")
FINE_M = 1e-4


def fine_encoders(compass_2sigma_deg: float | None, *, goals: int = 1) -> TownDrive:
    sensors = Sensors(compass_2sigma_deg=compass_2sigma_deg, encoder_step_m=FINE_M)
    return TownDrive(sensors=sensors, goals=goals)


def compass_innovations(settings: TownDrive, traced: Traced) -> tuple[Floats, Floats]:
    """Innovations of the compass, and their variances according to the filter."""
    sensors, track_m = settings.sensors, settings.car.track_width_m
    assert sensors.compass_2sigma_deg is not None
    left, right, compass = traced.steps[1:, 4:7].T
    before, var = traced.steps[:-1, 9], traced.steps[:-1, 15]
    slip = sensors.slip_per_sqrt_m**2 * np.abs(0.5 * (left + right))
    expected = before + (right - left) / track_m
    spread = var + 2.0 * slip / track_m**2 + (math.radians(sensors.compass_2sigma_deg) / 2.0) ** 2
    is_read = ~np.isnan(compass)
    return wrap_all(compass - expected)[is_read], spread[is_read]


@pytest.mark.slow
@pytest.mark.parametrize("goals", [1, 1_000_000], ids=["to the goal", "as far as allowed"])
def test_nees_with_a_ten_degree_compass_is_in_its_band(goals: int) -> None:
    count = 1000 if goals == 1 else 150
    settings = fine_encoders(10.0, goals=goals).model_copy(update={"longest_m": 20_000.0})
    rows = drive_many(settings, np.arange(count, dtype=np.uint64))
    low, high = mean_band(3, count)

    assert low < rows[:, NEES].mean() < high


@pytest.mark.parametrize("compass_deg", [10.0, 20.0, 30.0])
def test_compass_innovations_are_white_and_consistent(compass_deg: float) -> None:
    settings = fine_encoders(compass_deg)
    parts = [compass_innovations(settings, drive_traced(settings, seed)) for seed in range(12)]
    nis = np.concatenate([off**2 / spread for off, spread in parts])
    following = np.concatenate(
        [(off[1:] * off[:-1]) / np.sqrt(spread[1:] * spread[:-1]) for off, spread in parts]
    )
    low, high = mean_band(1, len(nis))

    assert len(nis) > 20_000
    assert low < nis.mean() < high
    assert abs(following.mean()) < 2.0 / math.sqrt(len(following))


def test_errors_without_a_compass_are_consistent_along_an_arc() -> None:
    """NEES is too high in x, y and heading, but consistent in rotation and displacement."""
    settings = fine_encoders(None)
    ends = [drive_traced(settings, seed).steps[-1] for seed in range(400)]
    rows = drive_many(settings, np.arange(400, dtype=np.uint64))
    low, high = mean_band(3, 400)

    assert rows[:, NEES].mean() > high + 1.0
    assert low < np.mean([nees_along_the_arc(row) for row in ends]) < high
