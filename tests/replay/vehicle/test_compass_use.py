"""A magnetometer is used as a compass only where the vehicle file describes it."""

import pytest

from crosscue.replay.signals.kinds import Signal
from crosscue.replay.signals.plan import plan
from crosscue.replay.vehicle.vehicle import Compass, Vehicle
from support.memory_log import MAGNETOMETER


@pytest.mark.parametrize(
    ("compass", "is_used"),
    [
        (Compass(), False),
        (Compass(use=True), True),
        (Compass(hard_iron_t=(1e-5, 0.0, 0.0)), True),
        (Compass(hard_iron_t=(1e-5, 0.0, 0.0), use=False), False),
    ],
)
def test_magnetometer_is_used_if_calibrated_or_requested(compass: Compass, is_used: bool) -> None:
    vehicle = Vehicle(version=1, compass=compass)

    planned = plan([(0, MAGNETOMETER)], vehicle)

    assert (planned.source_of(Signal.MAGNETIC_FIELD) is not None) == is_used
    assert Vehicle(**vehicle.model_dump()).compass.uses_magnetometer == is_used
