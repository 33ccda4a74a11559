"""The range smoother and the range filter on simulated approaches."""

from __future__ import annotations

import numpy as np

from crosscue.eval.runs.tables.travelled import Odometer
from crosscue.eval.scoring.columns import RangeRows
from crosscue.eval.scoring.scene.ranges import smoothed_rows
from crosscue.fusion.intersection_range import RangeBelief, initialise, predict, update
from crosscue.replay.columns import Floats

SENSOR_M2, WAY_M2, STEP_M, STEP_NS = 4.0, 0.01, 1.0, 100_000_000


def odometer(steps: int) -> Odometer:
    start = np.arange(steps, dtype=np.int64) * STEP_NS
    same = np.full(steps, STEP_M), np.zeros(steps), np.full(steps, WAY_M2)
    return Odometer(iter([(start, start + STEP_NS, *same, np.zeros(steps, np.bool_))]))


def filtered(measured_m: Floats) -> list[RangeBelief]:
    found = [initialise(float(measured_m[0]), SENSOR_M2)]
    for value in measured_m[1:].tolist():
        found.append(update(predict(found[-1], STEP_M, WAY_M2), value, SENSOR_M2))
    return found


def rows(beliefs: list[RangeBelief]) -> RangeRows:
    n = len(beliefs)
    mean_m, var_m2 = np.array(beliefs).T
    t_ns = np.arange(n, dtype=np.int64) * STEP_NS + STEP_NS
    return RangeRows(t_ns, np.ones(n, np.int64), np.full(n, "start"), mean_m, var_m2)


def test_range_smoother_is_more_accurate_than_filter() -> None:
    rng = np.random.default_rng(seed=3)
    true_m = 60.0 - STEP_M * np.arange(50)
    filter_m2, smoother_m2 = [], []
    for _ in range(20):
        before = rows(filtered(true_m + rng.normal(0.0, 2.0, 50)))
        after = smoothed_rows(before, odometer(51))
        filter_m2.append(np.mean((before.range_m - true_m) ** 2))
        smoother_m2.append(np.mean((after.range_m - true_m) ** 2))
        assert after.range_m[-1] == before.range_m[-1]
        assert (after.var_m2 <= before.var_m2 + 1e-12).all()

    assert np.mean(smoother_m2) < 0.8 * np.mean(filter_m2)
