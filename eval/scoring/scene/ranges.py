"""Errors of the range filter, and consistency of its variances (NEES)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.runs.tables.travelled import Odometer
from crosscue.eval.scoring.columns import AMBIGUOUS, RangeRows, RunTables
from crosscue.eval.scoring.intervals import Mean, mean
from crosscue.eval.scoring.places import cluster_numbers
from crosscue.eval.scoring.pooling import BINS_M, distance_bins, first_reasons, sum_counts
from crosscue.eval.scoring.pose.errors import FilterAndSmoother, NeesSummary, summarise_nees
from crosscue.eval.scoring.truth import DriveTruth
from crosscue.fusion.intersection_range import RangeBelief, predict, smooth_ranges
from crosscue.replay.columns import Floats, Int64s

# Squared jump of a range, in units of its variance, above which the filter has restarted.
RESTART_NIS: Final = 25.0


@dataclass(frozen=True, slots=True, eq=False)
class RangeJudged:
    """One reference (``start`` or ``end``) at N steps of one drive; arrays of shape (N,).

    Attributes:
        drive: Name of the drive.
        reference: ``start`` or ``end``.
        t_ns: Times.
        approach: Ids of true approaches.
        true_m: True ranges.
        error_m: Estimate minus truth.
        var_m2: Variance of the filter.
        left_out: Number of rows that could not be judged, by reason.
        controls: Control of the intersection in the truth, by id of the approach.
        places: Place by id of the approach.
    """

    drive: str
    reference: str
    t_ns: Int64s
    approach: Int64s
    true_m: Floats
    error_m: Floats
    var_m2: Floats
    left_out: dict[str, int]
    controls: Mapping[int, str]
    places: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class RangeBin:
    """Errors of the rows in one bin of true range, or at one kind of intersection."""

    rows: int
    bias_m: float
    rmse_m: float
    nees: float
    fraction_inside_95: float


@dataclass(frozen=True, slots=True)
class RangeScore:
    """Scores of one reference over all drives.

    Attributes:
        rows: Number of rows.
        scored: Number of rows with a true range.
        left_out: Number of rows by reason.
        bias_m: Mean error, with its interval over places.
        rmse_m: Root mean square error.
        p95_m: 95th percentile of absolute errors.
        nees: NEES; its band counts each place as one independent error.
        by_distance: Errors by true range.
        by_control: Errors by control of the intersection. A range to the end without a light comes
            from a false detection of a light.
    """

    rows: int
    scored: int
    left_out: dict[str, int]
    bias_m: Mean
    rmse_m: float
    p95_m: float
    nees: NeesSummary
    by_distance: dict[str, RangeBin]
    by_control: dict[str, RangeBin]


def sds_off(judged: RangeJudged) -> Floats:
    """Return absolute errors in standard deviations, shape (N,)."""
    return np.asarray(np.abs(judged.error_m) / np.sqrt(judged.var_m2), np.float64)


def judge_range(tables: RunTables, truth: DriveTruth) -> list[RangeJudged]:
    """Compare the run's ranges with the true ones; empty if either has none."""
    if tables.ranges is None or truth.ranges is None:
        return []
    rows = tables.ranges
    at = truth.approach_at(rows.t_ns)
    start, end = truth.ranges.at(rows.t_ns, at)
    controls = {one.id: one.control for one in truth.truth.approaches}
    judged = []
    for reference, true_m in (("start", start), ("end", end)):
        mine = rows.reference == reference
        ambiguous = tables.ambiguous.get(reference, 0)
        if not mine.any() and not ambiguous:
            continue
        reasons = {
            "not a number": ~(np.isfinite(rows.range_m) & np.isfinite(rows.var_m2)),
            "variance not positive": rows.var_m2 <= 0.0,
            "in the intersection": truth.is_crossing(rows.t_ns),
            "no true range at this time": ~np.isfinite(true_m),
        }
        mine, left_out = first_reasons(mine, reasons)
        if ambiguous:
            left_out[AMBIGUOUS] = ambiguous
        judged.append(
            RangeJudged(
                truth.drive,
                reference,
                rows.t_ns[mine],
                at[mine],
                true_m[mine],
                rows.range_m[mine] - true_m[mine],
                rows.var_m2[mine],
                left_out,
                controls,
                truth.places,
            )
        )
    return judged


def score_smoothed(
    tables: RunTables, truth: DriveTruth, odometer: Odometer
) -> dict[str, FilterAndSmoother]:
    """Return errors of the range filter and of its smoother, by reference."""
    if tables.ranges is None:
        return {}
    whole = replace(tables, ranges=smoothed_rows(tables.ranges, odometer))
    filtered, smoothed = (score_range(judge_range(one, truth)) for one in (tables, whole))
    return {
        name: FilterAndSmoother(
            one.scored, one.rmse_m, smoothed[name].rmse_m, one.nees.mean, smoothed[name].nees.mean
        )
        for name, one in filtered.items()
        if one.scored
    }


def smoothed_rows(rows: RangeRows, odometer: Odometer) -> RangeRows:
    """Return the rows smoothed backwards with the later measurements.

    Smoothing stops where odometry is missing or a range restarted.
    """
    times = np.unique(rows.t_ns)
    ways = [odometer.until(t_ns) for t_ns in times.tolist()]
    gone_m, var_m2, covered_ns = (
        np.cumsum([getattr(way, name) for way in ways])
        for name in ("distance_m", "var_m2", "covered_ns")
    )
    range_m, range_var_m2 = rows.range_m.copy(), rows.var_m2.copy()
    for approach, reference in dict.fromkeys(
        zip(rows.approach.tolist(), rows.reference.tolist(), strict=True)
    ):
        mine = np.flatnonzero((rows.approach == approach) & (rows.reference == reference))
        mine = mine[np.argsort(rows.t_ns[mine], kind="stable")]
        at = np.searchsorted(times, rows.t_ns[mine])
        steps_m, steps_m2 = np.diff(gone_m[at]), np.diff(var_m2[at])
        beliefs = [RangeBelief(rows.range_m[i], rows.var_m2[i]) for i in mine.tolist()]
        goes_on = np.diff(covered_ns[at]) >= np.diff(rows.t_ns[mine])
        goes_on &= np.array(
            [
                _goes_on(predict(before, *step), after)
                for before, after, *step in zip(
                    beliefs[:-1], beliefs[1:], steps_m.tolist(), steps_m2.tolist(), strict=True
                )
            ],
            np.bool_,
        )
        ends = [0, *(np.flatnonzero(~goes_on) + 1).tolist(), len(beliefs)]
        for first, stop in pairwise(ends):
            inside = slice(first, stop - 1)
            found = smooth_ranges(
                beliefs[first:stop], steps_m[inside].tolist(), steps_m2[inside].tolist()
            )
            range_m[mine[first:stop]] = [one.mean_m for one in found]
            range_var_m2[mine[first:stop]] = [one.var_m2 for one in found]
    return replace(rows, range_m=range_m, var_m2=range_var_m2)


def _goes_on(predicted: RangeBelief, after: RangeBelief) -> bool:
    """Return whether ``after`` may be an update of ``predicted``: less variance, and no jump."""
    gained_m2 = predicted.var_m2 - after.var_m2
    leap_m = after.mean_m - predicted.mean_m
    return gained_m2 > -1e-6 and leap_m**2 <= RESTART_NIS * max(gained_m2, 0.0) + 1e-6


def score_range(
    judged: Sequence[RangeJudged], bins_m: Sequence[float] = BINS_M
) -> dict[str, RangeScore]:
    """Return scores by reference, over all drives together."""
    return {
        reference: _score([one for one in judged if one.reference == reference], bins_m)
        for reference in dict.fromkeys(one.reference for one in judged)
    }


def _score(rows: Sequence[RangeJudged], bins_m: Sequence[float]) -> RangeScore:
    error = np.concatenate([one.error_m for one in rows])
    nees = error**2 / np.concatenate([one.var_m2 for one in rows])
    true_m = np.concatenate([one.true_m for one in rows])
    clusters = cluster_numbers(rows)
    left_out = sum_counts(one.left_out for one in rows)
    return RangeScore(
        rows=len(error) + sum(left_out.values()),
        scored=len(error),
        left_out=left_out,
        bias_m=mean(error, clusters),
        rmse_m=_rms(error),
        p95_m=float(np.percentile(np.abs(error), 95)) if len(error) else math.nan,
        nees=summarise_nees(nees, 1, max(len(np.unique(clusters)), 1)),
        by_distance={
            name: _bin(error[mask], nees[mask])
            for name, mask in distance_bins(true_m, bins_m).items()
            if mask.any()
        },
        by_control={
            name: _bin(error[mask], nees[mask]) for name, mask in _by_control(rows).items()
        },
    )


def _by_control(rows: Sequence[RangeJudged]) -> dict[str, NDArray[np.bool_]]:
    names = [one.controls.get(number, "") for one in rows for number in one.approach.tolist()]
    found = np.array(names, np.str_)
    return {name: found == name for name in sorted(set(names) - {""})}


def _rms(error: Floats) -> float:
    return float(np.sqrt(np.mean(error**2))) if len(error) else math.nan


def _bin(error: Floats, nees: Floats) -> RangeBin:
    return RangeBin(
        rows=len(error),
        bias_m=float(error.mean()),
        rmse_m=_rms(error),
        nees=float(nees.mean()),
        fraction_inside_95=summarise_nees(nees, 1).fraction_inside_95,
    )
