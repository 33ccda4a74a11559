"""Tests of single simulated drives: reproducibility, and the effect of the compass."""

import numpy as np

from crosscue.localization.town.drive import DriveOutcome, simulate_town_drive
from crosscue.localization.town.settings import City, Sensors, TownDrive

TOWN = City(largest_km2=2.0)


def test_drive_depends_only_on_its_seed() -> None:
    settings = TownDrive(city=TOWN)

    assert simulate_town_drive(settings, 4) == simulate_town_drive(settings, 4)
    assert simulate_town_drive(settings, 4) != simulate_town_drive(settings, 5)


def test_better_compass_keeps_the_error_ellipse_smaller() -> None:
    poor, good = (
        simulate_town_drive(TownDrive(city=TOWN, sensors=Sensors(compass_2sigma_deg=deg)), 6)
        for deg in (30.0, 10.0)
    )

    per_metre = [result.major_axis_m**2 / result.travelled_m for result in (poor, good)]
    assert per_metre[1] < per_metre[0]


def test_car_without_a_compass_is_lost_within_a_kilometre() -> None:
    settings = TownDrive(city=City(smallest_km2=20.0), sensors=Sensors(compass_2sigma_deg=None))
    results = [simulate_town_drive(settings, seed) for seed in range(8)]

    lost = [r for r in results if r.outcome == DriveOutcome.LOST]
    assert len(lost) >= 6
    assert np.mean([r.travelled_m for r in lost]) < 1000.0
