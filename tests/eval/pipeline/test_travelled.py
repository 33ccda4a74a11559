"""Motion between two times, read from the stored odometry of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crosscue.eval.pipeline.scene.variants import scene_tables
from crosscue.eval.runs.tables.travelled import Odometer, Way, odometer_of
from crosscue.eval.scoring.run_tables import in_log_time
from crosscue.eval.scoring.scene.ranges import smoothed_rows
from crosscue.replay.time.segments import ONE_SEGMENT
from crosscue.replay.vehicle.vehicle import parse
from support.gap_drive import VEHICLE, Clock, replayed, write_drive

SECOND = 1_000_000_000


def _odometer() -> Odometer:
    """Odometry at 10 m/s: two seconds, an assumed gap of two seconds, and two more seconds."""
    start = np.array([0, 1, 2, 4, 5]) * SECOND
    stop = np.array([1, 2, 4, 5, 6]) * SECOND
    distance_m = np.array([10.0, 10.0, 20.0, 10.0, 10.0])
    is_gap = np.array([False, False, True, False, False])
    return Odometer(iter([(start, stop, distance_m, 0.1 * distance_m, 0.01 * distance_m, is_gap)]))


def test_distance_across_gap_is_reported_as_assumed() -> None:
    odometer = _odometer()

    assert odometer.until(SECOND) == Way(10.0, 0.1, 1.0, SECOND)
    assert odometer.until(3 * SECOND) == Way(20.0, 0.2, 2.0, 2 * SECOND, SECOND, 10.0)
    rest = odometer.until(6 * SECOND)
    assert (rest.distance_m, rest.assumed_m) == pytest.approx((30.0, 10.0))


def test_distance_before_skip_is_not_counted() -> None:
    odometer = _odometer()

    odometer.skip_to(3 * SECOND)

    assert odometer.until(5 * SECOND) == Way(10.0, 0.1, 1.0, SECOND)


@pytest.mark.parametrize("kind", ["curve", "motion"])
def test_process_noise_of_a_range_enters_in_one_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Noise that grows with the distance reaches the filter, tracks and the smoother."""
    run = replayed(tmp_path, write_drive(tmp_path, Clock(), seconds=9))
    sections = f'[ranges]\nkind = "{kind}"\n[ranges.stop_sign]\n'
    vehicle = parse(VEHICLE.replace("[ranges.stop_sign]\n", sections), "car.toml")
    before = scene_tables(run, vehicle)
    rows = in_log_time("run", {"range": before["range"]}, ONE_SEGMENT).ranges
    assert rows is not None
    smoothed = smoothed_rows(rows, odometer_of(run))

    def more(travelled_m: float, odometry_var_m2: float, seconds: float) -> float:
        return odometry_var_m2 + (0.3 * travelled_m) ** 2

    monkeypatch.setattr("crosscue.eval.runs.tables.travelled.range_noise_m2", more)
    after = scene_tables(run, vehicle)

    widths = [np.array(one["range"]["var_m2"].to_pylist()) for one in (before, after)]
    assert len(widths[0]) == len(widths[1]) > 20
    assert widths[1].mean() > 1.02 * widths[0].mean()
    assert not np.array_equal(smoothed.range_m, smoothed_rows(rows, odometer_of(run)).range_m)
