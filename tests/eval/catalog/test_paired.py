"""Paired comparison of runs: simulated false alarms, and detectable differences."""

import math

import numpy as np
import pytest

from crosscue.eval.catalog.paired import (
    FALSE_ALARMS,
    MIN_DRIVES,
    _swaps,
    compare_drives,
    step_down,
)
from crosscue.eval.fleet.compare import compare_command
from crosscue.eval.scoring.by_drive import DriveMetric, Kind
from crosscue.replay.columns import Floats

TRIALS = 1000
METRICS: dict[str, Kind] = {
    "cues.a.precision": "mean",
    "cues.b.recall": "mean",
    "belief.left.brier": "mean",
    "range.start.rmse_m": "rms",
    "approaches.extra": "sum",
}


def simulated_metrics(
    rng: np.random.Generator, drives: int, shift: float = 0.0, hard: Floats | None = None
) -> list[DriveMetric]:
    """Metrics of one run that depend on each other and on the difficulty of each drive."""
    hard = rng.normal(0.0, 1.0, drives) if hard is None else hard
    found = []
    for drive in range(drives):
        luck = rng.normal(0.0, 0.3)
        for path, kind in METRICS.items():
            rows = int(rng.integers(1, 40)) if kind != "sum" else 1
            level = 1.0 / (1.0 + math.exp(-(hard[drive] + luck + shift)))
            wrong = float(rng.binomial(rows, level)) if kind != "sum" else float(luck > 0.3)
            found.append(DriveMetric(f"log {drive}", path, kind, wrong, rows))
    return found


@pytest.mark.parametrize(("drives", "times"), [(6, 100), (8, TRIALS), (30, 30)])
def test_false_alarm_rate_of_equal_runs_is_as_stated(drives: int, times: int) -> None:
    rng = np.random.default_rng(drives)
    alarms = worse = 0
    for _ in range(times):
        hard = rng.normal(0.0, 1.0, drives)
        one, other = (simulated_metrics(rng, drives, hard=hard) for _ in range(2))
        verdicts = {found.verdict for found in compare_drives(one, other)}
        alarms += verdicts != {"undecided"}
        worse += "worse" in verdicts

    assert alarms / times <= FALSE_ALARMS + 2.0 * math.sqrt(FALSE_ALARMS / times)
    if times == TRIALS:
        stated = f"{worse} of {times:,} simulated comparisons of equal runs"
        assert stated in " ".join((compare_command.__doc__ or "").split())


def test_changed_metric_raises_no_false_alarms_for_others() -> None:
    rng = np.random.default_rng(11)
    drives, swaps = 10, _swaps(10)
    # Three metrics of differences by drive: the first is shifted far, the others are noise.
    noise = rng.normal(0.0, 1.0, (TRIALS, 3, drives)) + np.array([5.0, 0.0, 0.0])[:, None]
    signs = 1.0 - 2.0 * swaps
    means = np.abs(noise @ signs.T) / np.sqrt((noise**2).sum(axis=2, keepdims=True))
    corrected = np.array([step_down(one)[0] for one in means])
    single = np.array([(one.max(axis=0) >= one[:, :1] - 1e-9).mean(axis=1) for one in means])

    assert (corrected[:, 0] <= FALSE_ALARMS).all()
    false = (corrected[:, 1:] <= FALSE_ALARMS).any(axis=1).mean()
    assert false == pytest.approx(FALSE_ALARMS, abs=2.0 * math.sqrt(FALSE_ALARMS / TRIALS))
    # At least as powerful as judging every metric by the largest difference of all.
    assert (corrected <= single + 1e-9).all()
    assert (single[:, 1:] <= FALSE_ALARMS).any(axis=1).mean() < false


def test_recommended_number_of_drives_has_stated_power() -> None:
    rng = np.random.default_rng(5)
    path = "cues.a.precision"

    def parts(drives: int, shift: float) -> list[DriveMetric]:
        values = 0.5 + shift + rng.normal(0.0, 0.1, drives)
        return [DriveMetric(str(i), path, "mean", 10.0 * v, 10) for i, v in enumerate(values)]

    opened = [compare_drives(parts(12, 0.0), parts(12, 0.06))[0] for _ in range(200)]
    more = [one.more_drives for one in opened if abs(one.after - one.before - 0.06) < 0.01]
    recommended = 12 + int(np.median([one for one in more if one]))
    detected = [
        compare_drives(parts(recommended, 0.0), parts(recommended, 0.06))[0].verdict == "better"
        for _ in range(100)
    ]

    assert np.mean(detected) == pytest.approx(0.8, abs=0.12)
    assert {one.more_drives for one in opened if one.verdict != "undecided"} <= {0}


def test_detectable_difference_is_found_in_four_of_five_trials() -> None:
    rng = np.random.default_rng(4)
    path, drives, times = "cues.a.precision", 20, 300
    detected, stated = 0, []

    def parts(shift: float) -> list[DriveMetric]:
        values = 0.5 + shift + rng.normal(0.0, 0.1, drives)
        return [DriveMetric(str(i), path, "mean", 10.0 * v, 10) for i, v in enumerate(values)]

    # Two runs with noise of 0.1 each over 20 drives: (2.09 + 0.84) * 0.1 * sqrt(2 / 20).
    for _ in range(times):
        (one,) = compare_drives(parts(0.0), parts(0.0927))
        stated.append(one.could_see)
        detected += one.verdict == "better"

    assert np.mean(stated) == pytest.approx(0.0927, rel=0.1)
    assert detected / times == pytest.approx(0.8, abs=0.08)


@pytest.mark.parametrize("drives", [1, 3, MIN_DRIVES - 1])
def test_too_few_drives_decide_nothing(drives: int) -> None:
    before, after = (
        [DriveMetric(str(i), "cues.a.precision", "mean", total, 10) for i in range(drives)]
        for total in (10.0, 0.0)
    )
    (one,) = compare_drives(before, after)

    assert one.verdict == "undecided"
    assert math.isinf(one.could_see)
    assert math.isnan(one.low) == (drives < 4)


def test_equal_runs_are_undecided_and_order_of_drives_is_irrelevant() -> None:
    parts = simulated_metrics(np.random.default_rng(2), 8)
    other = simulated_metrics(np.random.default_rng(3), 8)

    for one in compare_drives(parts, parts):
        assert (one.before, one.p, one.verdict) == (one.after, 1.0, "undecided")
    forward = {one.path: one for one in compare_drives(parts, other)}
    shuffled = {one.path: one for one in compare_drives(parts[::-1], other[::-1])}
    assert {path: one.p for path, one in forward.items()} == {
        path: pytest.approx(one.p) for path, one in shuffled.items()
    }
