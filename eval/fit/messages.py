"""Annotated approaches from runs and their truth, for the fit of messages.

A run's approach stands for the true one that it shares most time with, while the car drives up to
it. One that meets no true approach is one to nothing: no intersection, no way left or right (of
straight ahead nothing is known: the road goes on). Other frames are left out.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from crosscue.datasets.truth.truth import Truth
from crosscue.eval.fit.frame_counts import counts_at, places_in
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.tables.log_time import refuse_set_back
from crosscue.eval.runs.tables.travelled import odometer_of
from crosscue.eval.scoring.intervals import TOO_FEW as TOO_FEW
from crosscue.eval.scoring.intervals import Interval, mean_by_cluster, wilson
from crosscue.eval.scoring.truth import CROSSING_NS
from crosscue.fusion.factor_graph import FactorGraph, graph_of
from crosscue.fusion.fit.annotated_approach import AnnotatedApproach
from crosscue.fusion.fit.message_fit import MessageFit, RateFit, Side
from crosscue.replay.base import Floats, Int64s, RunError, UsageError
from crosscue.replay.vehicle.vehicle import Vehicle

COVERED: Final = 0.9
"""Of the time between two frames, at least so much must have odometry."""
NOTHING_THERE: Final = {"intersection": False, "left": False, "right": False}


@dataclass(slots=True)
class Annotated:
    """What runs and truths gave.

    Attributes:
        approaches: To learn from.
        used: Approaches of runs by what they were.
    """

    approaches: list[AnnotatedApproach]
    used: Counter[str]


def graph_of_runs(runs: Sequence[RunFolder]) -> tuple[FactorGraph, Vehicle]:
    """The factor graph that all runs share, and the first one's settings.

    Raises:
        UsageError: They do not share one.
        RunError: A manifest cannot be read.
    """
    vehicles = [run.drive_manifest().settings for run in runs]
    graphs = [graph_of(vehicle.fusion) for vehicle in vehicles]
    for run, graph in zip(runs, graphs, strict=True):
        if graph != graphs[0]:
            raise UsageError(
                f"{run.path}: made with other cues or features than {runs[0].path}; "
                "run crosscue estimate with one vehicle file"
            )
    return graphs[0], vehicles[0]


def annotate(run: RunFolder, truth: Truth, vehicle: Vehicle, into: Annotated) -> None:
    """Add one run's approaches.

    Raises:
        RunError: A table is missing or damaged, or nothing of the run lies in the truth's time.
    """
    refuse_set_back(run.drive_manifest().timeline, run.path, "fit messages")
    belief = run.table("belief", ["t_ns", "approach", "established"])
    t_ns = _whole(belief["t_ns"])
    number, established = _whole(belief["approach"]), np.asarray(belief["established"])
    if len(t_ns) and not ((t_ns >= truth.start_ns) & (t_ns < truth.end_ns)).any():
        raise RunError(
            f"{run.path}: no approach between {truth.start_ns} and {truth.end_ns} ns, of which the "
            "truth speaks; give the truth of this drive"
        )
    way_m = _ways(run, t_ns, vehicle)
    near = _near(run, t_ns, vehicle)
    counts = counts_at(run.table("cues", ["t_ns", "cue", "count"]), t_ns)
    for one in np.unique(number).tolist():
        rows = np.flatnonzero(number == one)
        kept, features, place, what = _meant(t_ns[rows], truth)
        into.used[what] += 1
        if features is None or not kept.any():
            continue
        rows = rows[kept]
        before = np.concatenate([[False], established[number == one][:-1]])[kept]
        into.approaches.append(
            AnnotatedApproach(
                way_m[rows] - way_m[rows[0]],
                (t_ns[rows] - t_ns[rows[0]]) * 1e-9,
                near[rows],
                before.astype(np.bool_),
                {cue: column[rows] for cue, column in counts.items()},
                features,
                place or f"{run.path}, approach {one}",
            )
        )


def _meant(
    t_ns: Int64s, truth: Truth
) -> tuple[np.typing.NDArray[np.bool_], dict[str, bool] | None, str, str]:
    """Which frames count, what is true, which intersection, and what the approach was."""
    shared = [((t_ns >= a.start_ns) & (t_ns < a.enter_ns)).sum() for a in truth.approaches]
    if shared and max(shared) > 0:
        one = truth.approaches[int(np.argmax(shared))]
        features = {"intersection": True, **one.features.model_dump()}
        before = (t_ns >= one.start_ns) & (t_ns < one.enter_ns)
        if None in features.values():
            return before, None, "", "to an intersection with unknown roads, left out"
        return before, features, one.intersection, "to an intersection"
    inside = (t_ns >= truth.start_ns) & (t_ns < truth.end_ns)
    for a in truth.approaches:
        if ((t_ns >= a.enter_ns) & (t_ns < a.enter_ns + CROSSING_NS)).any():
            return inside, None, "", "in an intersection, left out"
    if not inside.all():
        return inside, None, "", "outside the truth's time, left out"
    return inside, dict(NOTHING_THERE), "", "to nothing"


def _whole(column: object) -> Int64s:
    return np.asarray(column, np.int64)


def _ways(run: RunFolder, t_ns: Int64s, vehicle: Vehicle) -> Floats:
    """Way gone up to each of the sorted times, forwards or back, reckoned where unknown."""
    odometer = odometer_of(run)
    gone, total, last_ns = np.empty(len(t_ns)), 0.0, None
    for i, now_ns in enumerate(t_ns.tolist()):
        way = odometer.until(now_ns)
        gap_ns = 0 if last_ns is None else now_ns - last_ns
        is_known = way.covered_ns >= COVERED * gap_ns
        reckoned_m = vehicle.range_filter.unseen_mps * gap_ns * 1e-9
        total += abs(way.distance_m) if is_known else reckoned_m
        gone[i], last_ns = total, now_ns
    return gone


def _near(run: RunFolder, t_ns: Int64s, vehicle: Vehicle) -> np.typing.NDArray[np.bool_]:
    """Frames in which the range that dissent goes by was within its reach."""
    table = run.table("range", ["t_ns", "reference", "range_m"])
    at, reference = _whole(table["t_ns"]), np.array(table["reference"].to_pylist(), np.str_)
    range_m = np.asarray(table["range_m"], np.float64)
    best = np.full(len(t_ns), np.inf)
    is_wanted = reference == vehicle.fusion.reference
    for rows in (~is_wanted, is_wanted):
        where, found = places_in(t_ns, at[rows])
        best[where] = range_m[rows][found]
    return np.asarray(best <= vehicle.fusion.dissent_within_m)


class SideTold(NamedTuple):
    """A rate and how sure it is.

    Attributes:
        rate: Mean over places; NaN without any.
        wilson: Interval by independent observations; rounding them to whole ones costs less than
            pretending that every frame is one.
        places: Interval over places; NaN for fewer than four.
    """

    rate: float
    wilson: Interval
    places: Interval


def rates_of(side: Side) -> SideTold:
    """A side's rate with both intervals."""
    looks = round(side.looks)
    rates = np.array(side.rates)
    return SideTold(
        float(rates.mean()) if len(rates) else math.nan,
        wilson(min(round(side.hits), looks), looks),
        mean_by_cluster(rates, np.arange(len(rates))),
    )


def section_of(fit: MessageFit) -> str:
    """The vehicle file's section, with counts as comments."""
    lines = ["[fusion.calibrated]", "rates = ["]
    lines += [_rate_line(one) for one in fit.rates if one.rates is not None]
    lines += ["]", "", "[fusion.calibrated.exponents]"]
    lines += [f"{name} = {value:.3f}" for name, value in fit.calibrated.exponents.items()]
    lines += ["", "[fusion.calibrated.fades]"]
    for one in fit.fades:
        if one.is_learned:
            key, value = ("way_m", one.fade.way_m), ("time_s", one.fade.time_s)
            name, number = key if key[1] is not None else value
            lines.append(
                f"{one.cue} = {{ {name} = {number:.3g} }}  "
                f"# {one.positives} positive of {one.looks} frames"
            )
    return "\n".join(lines) + "\n"


def _rate_line(one: RateFit) -> str:
    assert one.rates is not None
    return (
        f'  {{ cue = "{one.cue}", feature = "{one.feature}", near = {str(one.near).lower()}, '
        f"if_there = {one.rates.if_there:.4g}, if_not = {one.rates.if_not:.4g} }},  "
        f"# {one.there.places} and {one.missing.places} places"
    )
