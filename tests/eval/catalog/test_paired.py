"""Paired comparison of runs, detectable differences, and a metric over versions."""

import math
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from crosscue.eval import cli
from crosscue.eval.catalog import paired
from crosscue.eval.catalog.paired import (
    FALSE_ALARMS,
    PairedMetric,
    _swaps,
    compare_drives,
    step_down,
)
from crosscue.eval.fleet.compare import compare_command
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.tags import write_tags
from crosscue.eval.scoring.by_drive import DriveMetric, Kind
from crosscue.eval.scoring.intervals import MIN_CLUSTERS
from crosscue.replay.columns import Floats
from support.catalog_runs import scored_run
from support.commands import output_of
from support.refusals import refusal
from support.scoring import log_row

TRIALS = 1000
TIMES = 200
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
def test_false_alarm_rate_of_equal_runs_is_as_stated(
    drives: int, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paired, "detectable", lambda *_: {})
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
    corrected = np.array([step_down(one) for one in means])
    single = np.array([(one.max(axis=0) >= one[:, :1] - 1e-9).mean(axis=1) for one in means])

    assert (corrected[:, 0] <= FALSE_ALARMS).all()
    false = (corrected[:, 1:] <= FALSE_ALARMS).any(axis=1).mean()
    assert false == pytest.approx(FALSE_ALARMS, abs=2.0 * math.sqrt(FALSE_ALARMS / TRIALS))
    # At least as powerful as judging every metric by the largest difference of all.
    assert (corrected <= single + 1e-9).all()
    assert (single[:, 1:] <= FALSE_ALARMS).any(axis=1).mean() < false


def test_recommended_number_of_places_has_stated_power() -> None:
    """From what is detectable at 12 places; comparisons that are open have the larger spreads."""
    rng = np.random.default_rng(5)
    path = "cues.a.precision"

    def parts(drives: int, shift: float) -> list[DriveMetric]:
        values = 0.5 + shift + rng.normal(0.0, 0.1, drives)
        return [DriveMetric(str(i), path, "mean", 10.0 * v, 10) for i, v in enumerate(values)]

    opened = [compare_drives(parts(12, 0.0), parts(12, 0.06))[0] for _ in range(TIMES // 2)]
    more = [paired._more_places(one.could_see, 0.06, 12) or 0 for one in opened]
    recommended = 12 + int(np.median(more))
    detected = [
        compare_drives(parts(recommended, 0.0), parts(recommended, 0.06))[0].verdict == "better"
        for _ in range(100)
    ]

    assert np.mean(detected) == pytest.approx(0.8, abs=0.12)
    assert {one.more_places for one in opened if one.verdict != "undecided"} <= {0}


@pytest.mark.parametrize(("places", "metrics"), [(6, 1), (8, 5), (20, 1)])
def test_detectable_difference_is_found_in_four_of_five_comparisons(
    places: int, metrics: int
) -> None:
    """Each stated difference, tested in another simulated comparison of as many places."""
    rng = np.random.default_rng([places, metrics])

    def compared(loss: float) -> PairedMetric:
        return compare_drives(
            values(rng, places, metrics, 0.0), values(rng, places, metrics, loss)
        )[0]

    stated = [compared(0.0).could_see for _ in range(TIMES // 2)]
    found = np.mean([compared(loss).verdict == "worse" for loss in stated])

    assert found == pytest.approx(0.8, abs=0.1)
    # A normal distribution of the difference promises too much for few places.
    normal = (1.96 + 0.84) * 0.1 * math.sqrt(2.0 / places)
    assert np.mean(stated) > normal * (1.3 if places < 12 else 1.0)


@pytest.mark.parametrize("places", [10, 12])
def test_detectable_difference_needs_only_some_of_the_swaps(
    places: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first 512 in order never swapped the last places, so it was overstated by a tenth."""
    residuals = np.random.default_rng(places).normal(0.0, 0.1, places) / places
    weights = np.full(places, 1.0 / places)
    effects = {"a": paired.Effects(residuals - residuals.mean(), weights, 1.0, 2.2)}
    some = paired.detectable(effects, _swaps(places))["a"]
    monkeypatch.setattr(paired, "TRIED", 1 << places)

    every = paired.detectable(effects, _swaps(places))["a"]
    assert some == pytest.approx(every, rel=0.03)


def values(rng: np.random.Generator, places: int, metrics: int, loss: float) -> list[DriveMetric]:
    """One drive per place with independent metrics; the first is worse by ``loss``."""
    return [
        DriveMetric(
            str(place),
            f"cues.{number}.precision",
            "mean",
            10.0 * (0.5 - loss * (number == 0) + rng.normal(0.0, 0.1)),
            10,
        )
        for place in range(places)
        for number in range(metrics)
    ]


def at_places(rng: np.random.Generator, places: int, each: int) -> list[DriveMetric]:
    """Drives of one run whose errors are partly those of their place."""
    found = []
    for place in range(places):
        error = rng.normal(0.0, 0.4)
        for drive in range(each):
            rows = int(rng.integers(20, 40))
            level = 1.0 / (1.0 + math.exp(-(1.0 + error + rng.normal(0.0, 0.1))))
            right = float(rng.binomial(rows, level))
            name = [f"place {place}"]
            found.append(
                DriveMetric(f"{place}-{drive}", "cues.a.recall", "mean", right, rows, name)
            )
    return found


def without_places(parts: list[DriveMetric]) -> list[DriveMetric]:
    return [one._replace(places=()) for one in parts]


@pytest.mark.parametrize(("places", "each"), [(5, 4), (8, 3), (12, 3)])
def test_equals_that_share_places_get_verdicts_at_the_stated_rate(
    places: int, each: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """20 drives of 5 places had a verdict in 18 % as 20 places; fewer than six places decide."""
    monkeypatch.setattr(paired, "detectable", lambda *_: {})
    rng = np.random.default_rng(places)
    pairs = [(at_places(rng, places, each), at_places(rng, places, each)) for _ in range(TIMES)]
    verdicts = [compare_drives(*pair)[0].verdict for pair in pairs]
    alone = [
        compare_drives(without_places(first), without_places(second))[0].verdict
        for first, second in pairs
    ]

    slack = 2.0 * math.sqrt(FALSE_ALARMS * (1.0 - FALSE_ALARMS) / TIMES)
    rate = np.mean([one in ("better", "worse") for one in verdicts])
    assert rate <= FALSE_ALARMS + slack
    assert np.mean([one in ("better", "worse") for one in alone]) > FALSE_ALARMS + slack
    if places < MIN_CLUSTERS:
        assert set(verdicts) == {"too few places"}
    else:
        assert rate > 0.0


def test_too_few_places_state_the_number_wanted() -> None:
    rng = np.random.default_rng(3)
    (one,) = compare_drives(at_places(rng, 5, 4), at_places(rng, 5, 4))

    assert (one.drives, one.places, one.verdict) == (20, 5, "too few places")
    assert one.more_places == 1
    assert math.isnan(one.low)


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


RECALL, BRIER = "cues.stop_sign.recall", "belief.left.brier"
MODELS = ("m0", "m1", "m2", "m3")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight drives with four models, the third of which finds fewer signs; one run has no score."""
    folder = tmp_path_factory.mktemp("fleet")
    rng = np.random.default_rng(2)
    for at, model in enumerate(MODELS):
        for drive in range(8):
            path = folder / f"{9 - at}-{drive}"
            log = folder / f"drive{drive}.mcap"
            log.write_text(f"drive {drive}")
            right = 70.0 + 2.0 * drive + rng.integers(0, 3) - 15.0 * (at >= 2)
            parts = [
                DriveMetric(f"drive {drive}", RECALL, "mean", right, 100),
                DriveMetric(f"drive {drive}", BRIER, "mean", 5.0 + rng.normal(), 100),
                DriveMetric(f"drive {drive}", "cues.stop_sign.positives", "sum", 9.0, 1),
            ]
            run = scored_run(path, parts, logs=(log_row(log, RunFolder(path)),))
            os.utime(run.path / "manifest.json", (1.7e9 + at, 1.7e9 + at))
            write_tags(run.path, {"model": model})
    shutil.rmtree(run.path / "score")
    return folder


def test_page_plots_each_metric_and_marks_its_changes(fleet: Path, tmp_path: Path) -> None:
    page = tmp_path / "history.html"

    printed = output_of("history", fleet, "--by", "model", "-o", page)
    assert re.search(rf"WORSE +{re.escape(RECALL)}: 0\.7\d+ -> 0\.6\d+ from model m2 on", printed)
    assert "2 metrics over 4 models; 1 changed" in printed
    assert "left out   1 run without a score" in printed
    text = page.read_text()
    assert f"{RECALL} m2 worse" in " ".join(re.sub("<[^>]*>", " ", text).split())
    assert text.count("<svg") == 2
    assert not re.search("<(script|link|img|iframe)", text)
    first = page.read_bytes()
    assert cli.run(["history", str(fleet), "--by", "model", "-o", str(page)]) == 1
    argv = ["history", str(fleet), "--by", "model", "-o", str(page), "--overwrite", "-q"]
    assert cli.run(argv) == 0
    assert page.read_bytes() == first


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["--by", "no_such_tag"], 1, "no scored run of 32 has a no_such_tag"),
        (["--by", "it's"], 1, "no scored run of 32 has a it's"),
        (["--by", "model", "--metrics", "x.*"], 1, "no judged metric fits x.*"),
    ],
)
def test_history_without_matching_runs_or_metrics_is_refused(
    fleet: Path, words: list[str], status: int, message: str
) -> None:
    assert message in refusal(status, "history", fleet, *words)
