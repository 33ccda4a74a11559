"""Tests of single simulated drives: reproducibility, and the effect of the compass."""

import numpy as np

from crosscue.localization.town.drive import DriveOutcome, simulate_town_drive
from crosscue.localization.town.settings import City, Sensors, TownDrive


def test_car_without_a_compass_is_lost_within_a_kilometre() -> None:
    settings = TownDrive(city=City(smallest_km2=20.0), sensors=Sensors(compass_2sigma_deg=None))
    results = [simulate_town_drive(settings, seed) for seed in range(8)]

    lost = [r for r in results if r.outcome == DriveOutcome.LOST]
    assert len(lost) >= 6
    assert np.mean([r.travelled_m for r in lost]) < 1000.0
