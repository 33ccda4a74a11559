"""Verdicts of simulated comparisons: between equals that share places, and of stated losses.

Run it as ``python benchmarks/comparisons.py [--trials 300]``; it takes about three minutes.

*Equals*: two runs of 20 drives of 5, 10 or 20 places, five metrics of each, whose errors are partly
those of the place and of the metric's run there. A verdict on any metric is a false one. *By drive*
is the same without places. *Losses*: the loss that the comparison states as detectable, in another
comparison of as many places; 80 % of them are to be found.
"""

from __future__ import annotations

import argparse
import math

import numpy as np

from crosscue.eval.catalog import paired
from crosscue.eval.catalog.paired import PairedMetric, compare_drives
from crosscue.eval.scoring.by_drive import DriveMetric
from crosscue.eval.scoring.intervals import wilson

DRIVES = 20
LEVELS = {"a.recall": 0.7, "b.recall": 0.95, "a.precision": 0.9, "b.precision": 0.98}
DECIDED = ("better", "worse")


def a_run(rng: np.random.Generator, places: int, each: int, loss: float = 0.0) -> list[DriveMetric]:
    """Return the metrics of one run; the first has lost ``loss``."""
    found = []
    for place in range(places):
        here = rng.normal(0.0, 0.4)
        for drive in range(each):
            own = here + rng.normal(0.0, 0.1)
            log, at = f"{place}-{drive}", (f"place {place}",)
            for name, level in LEVELS.items():
                lost = loss if name == next(iter(LEVELS)) else 0.0
                rows = int(rng.integers(20, 40))
                odds = math.log(level / (1.0 - level)) + own + rng.normal(0.0, 0.2)
                rate = min(max(1.0 / (1.0 + math.exp(-odds)) - lost, 0.0), 1.0)
                right = float(rng.binomial(rows, rate))
                found.append(DriveMetric(log, f"cues.{name}", "mean", right, rows, at))
            error_m = 2.0 * math.exp(own) * rng.chisquare(20) / 20.0
            found.append(DriveMetric(log, "range.rmse_m", "rms", 20.0 * error_m**2, 20, at))
    return found


def equals(places: int, trials: int) -> str:
    """Return the rates of verdicts between equals, with the places and without them."""
    rng = np.random.default_rng([places, 27])
    any_of = {"by place": 0, "by drive": 0}
    few = worse = 0
    for _ in range(trials):
        runs = [a_run(rng, places, DRIVES // places) for _ in range(2)]
        alone = [[one._replace(places=()) for one in run] for run in runs]
        for name, (one, other) in (("by place", runs), ("by drive", alone)):
            verdicts = {found.verdict for found in compare_drives(one, other)}
            any_of[name] += not verdicts.isdisjoint(DECIDED)
            if name == "by place":
                few += verdicts == {"too few places"}
                worse += "worse" in verdicts
    text = f"{DRIVES} drives of {places} places: too few places in {100 * few / trials:.0f} %"
    for name, count in any_of.items():
        low, high = wilson(count, trials)
        rates = [100.0 * one for one in (count / trials, low, high)]
        text += "; a verdict {} in {:.1f} % ({:.1f} to {:.1f})".format(name, *rates)
    return f"{text}; worse by place in {100 * worse / trials:.1f} %"


def losses(places: int, trials: int) -> str:
    """Return how often a stated loss is found."""
    rng = np.random.default_rng([places, 28])

    def compared(loss: float) -> PairedMetric:
        found = compare_drives(a_run(rng, places, 2), a_run(rng, places, 2, loss))
        return next(one for one in found if one.path == f"cues.{next(iter(LEVELS))}")

    stated = np.array([compared(0.0).could_see for _ in range(trials)])
    found = sum(compared(loss).verdict == "worse" for loss in stated.tolist())
    low, high = wilson(found, trials)
    return (
        f"{places} places, {len(LEVELS) + 1} metrics: stated as detectable {np.mean(stated):.3f}; "
        f"found in {100 * found / trials:.0f} % ({100 * low:.0f} to {100 * high:.0f})"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--trials", type=int, default=300)
    trials = parser.parse_args().trials
    stated, paired.detectable = paired.detectable, lambda *_: {}
    for places in (5, 10, 20):
        print(equals(places, trials), flush=True)
    paired.detectable = stated
    for places in (8, 12):
        print(losses(places, trials), flush=True)


if __name__ == "__main__":
    main()
