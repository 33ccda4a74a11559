"""A magnetometer counts as a compass only where the vehicle file describes it."""

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
def test_a_magnetometer_without_calibration_is_used_only_on_request(
    compass: Compass, is_used: bool
) -> None:
    vehicle = Vehicle(version=1, compass=compass)

    planned = plan([(0, MAGNETOMETER)], vehicle)

    assert (planned.source_of(Signal.MAGNETIC_FIELD) is not None) == is_used
    assert Vehicle(**vehicle.model_dump()).compass.uses_magnetometer == is_used


def test_the_reason_names_the_topic_and_the_remedy() -> None:
    planned = plan([(0, MAGNETOMETER)], Vehicle(version=1))

    assert (
        "mag is not calibrated: run crosscue fit compass" in planned.missing[Signal.MAGNETIC_FIELD]
    )
