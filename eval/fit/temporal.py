"""Annotated drives from runs and their truth, for the fit of the belief over time.

A drive is divided: up to each intersection of the truth, and where none is ahead. Frames in an
intersection, or outside the truth's time, are left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.datasets.truth.truth import Truth
from crosscue.eval.fit.frame_counts import counts_at
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.tables.log_time import refuse_set_back
from crosscue.eval.runs.tables.travelled import odometer_of
from crosscue.eval.scoring.truth import CROSSING_NS, DriveTruth
from crosscue.fusion.fit.temporal_fit import AnnotatedDrive, TemporalFit
from crosscue.fusion.intersection_range import Reference
from crosscue.fusion.temporal import MeasuredRange, ranges_to_start
from crosscue.replay.vehicle.temporal import CueChain
from crosscue.replay.vehicle.vehicle import RangeCurve, Vehicle

if TYPE_CHECKING:
    import pyarrow as pa

NOTHING_THERE: Final = {"intersection": False, "left": False, "right": False}
CURVES: Final = {Reference.START: "stop_sign", Reference.END: "traffic_light"}


class _Moves(NamedTuple):
    """Between frames, shape (N,) each; of the first frame nothing."""

    way_m: NDArray[np.float64]
    var_m2: NDArray[np.float64]
    passed_s: NDArray[np.float64]


def annotated_drives(
    run: RunFolder,
    truth: DriveTruth,
    vehicle: Vehicle,
    tables: Mapping[str, pa.Table] | None = None,
) -> Iterator[AnnotatedDrive]:
    """The parts of one run.

    Args:
        run: With finished stages.
        truth: Of the drive.
        vehicle: Curves of ranges, and how fast they fade.
        tables: ``cues`` and ``range``, estimated with other settings; the run's, if left out.

    Raises:
        RunError: A table is missing or damaged.
    """
    refuse_set_back(run.drive_manifest().timeline, run.path, "fit temporal")
    if tables is None:
        columns = ["t_ns", "reference", "range_m", "var_m2", "measured_m"]
        tables = {
            "cues": run.table("cues", ["t_ns", "cue", "count"]),
            "range": run.table("range", columns),
        }
    t_ns = np.asarray(run.table("frames", ["t_ns"])["t_ns"], np.int64)
    moves = _moves(run, t_ns)
    counts = counts_at(tables["cues"], t_ns)
    ranges = _ranges(tables["range"], t_ns, moves.way_m, vehicle)
    start_m = truth.start_m(t_ns)
    for kept, features, place in _parts(truth.truth, t_ns):
        rows = np.flatnonzero(kept)
        if not len(rows):
            continue
        yield AnnotatedDrive(
            _from_first(moves.way_m[rows]),
            _from_first(moves.var_m2[rows]),
            _from_first(moves.passed_s[rows]),
            start_m[rows] if features["intersection"] else np.full(len(rows), np.nan),
            {cue: column[rows] for cue, column in counts.items()},
            tuple(ranges[i] for i in rows.tolist()),
            features,
            place or str(run.path),
        )


def _from_first(column: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same, without what lies before the part."""
    out = column.copy()
    out[0] = 0.0
    return out


def _parts(
    truth: Truth, t_ns: NDArray[np.int64]
) -> Iterator[tuple[np.typing.NDArray[np.bool_], dict[str, bool], str]]:
    """Frames of a part, what is true there, and the intersection's name."""
    ahead = np.zeros(len(t_ns), np.bool_)
    for one in truth.approaches:
        kept = (t_ns >= one.start_ns) & (t_ns < one.enter_ns)
        ahead |= kept | ((t_ns >= one.enter_ns) & (t_ns < one.enter_ns + CROSSING_NS))
        known = {
            name: value for name, value in one.features.model_dump().items() if value is not None
        }
        yield kept, {"intersection": True, **known}, one.intersection
    rest = ~ahead & (t_ns >= truth.start_ns) & (t_ns < truth.end_ns)
    begins = np.flatnonzero(np.diff(rest.astype(np.int8), prepend=0) == 1)
    for begin in begins.tolist():
        gaps = np.flatnonzero(~rest[begin:])
        end = begin + int(gaps[0]) if len(gaps) else len(rest)
        kept = np.zeros(len(rest), np.bool_)
        kept[begin:end] = True
        yield kept, dict(NOTHING_THERE), ""


def _moves(run: RunFolder, t_ns: NDArray[np.int64]) -> _Moves:
    odometer = odometer_of(run)
    ways = [odometer.until(now) for now in t_ns.tolist()]
    return _Moves(
        np.array([way.distance_m for way in ways], np.float64),
        np.array([way.var_m2 for way in ways], np.float64),
        np.diff(t_ns, prepend=t_ns[:1]) * 1e-9,
    )


def _ranges(
    table: pa.Table, t_ns: NDArray[np.int64], way_m: NDArray[np.float64], vehicle: Vehicle
) -> list[tuple[MeasuredRange, ...]]:
    """Of each frame, as the filter takes them."""
    measured: dict[int, dict[Reference, tuple[float, float]]] = {}
    columns = [table[name].to_pylist() for name in ("t_ns", "reference", "measured_m", "var_m2")]
    for at, reference, range_m, var_m2 in zip(*columns, strict=True):
        if range_m is not None:
            found = Reference(reference)
            one = range_m, _var_m2(found, range_m, var_m2, vehicle)
            measured.setdefault(at, {})[found] = one
    out: list[tuple[MeasuredRange, ...]] = []
    since_m = math.inf
    for now, moved_m in zip(t_ns.tolist(), way_m.tolist(), strict=True):
        since_m += abs(moved_m)
        here = measured.get(now)
        if not here:
            out.append(())
            continue
        found_ranges = ranges_to_start(
            here, since_m, vehicle.range_filter.fade_m, vehicle.fusion.length_m
        )
        out.append(tuple(MeasuredRange(*one) for one in found_ranges))
        since_m = 0.0
    return out


def _var_m2(reference: Reference, range_m: float, believed_m2: float, vehicle: Vehicle) -> float:
    """Of one measurement: that of its curve, or of the belief where it has no curve."""
    curve: RangeCurve | None = getattr(vehicle.ranges, CURVES[reference])
    own = believed_m2 if curve is None else curve.residual_sd_m**2
    return own + (vehicle.range_filter.sd_fraction * range_m) ** 2


def section_of(fit: TemporalFit) -> str:
    """The vehicle file's section, with what it was learned from."""
    learned = fit.temporal
    lines = [
        f"# Learned from {fit.drives} drives at {fit.places} places, {fit.steps} steps.",
        "[fusion.temporal]",
        f"ahead = {learned.ahead:.4f}",
        f"edges_m = {list(learned.edges_m)}",
        f"exponent = {learned.exponent}",
        f"lapse = {learned.lapse}",
        f"stray = {learned.stray}",
        "chains = [",
        *(f"  {_chain_line(one)}," for one in learned.chains),
        "]",
        "",
        "[fusion.temporal.ways]",
        *(f'"{name}" = {fraction}' for name, fraction in learned.ways.items()),
    ]
    return "\n".join(lines) + "\n"


def _chain_line(one: CueChain) -> str:
    parts = [f'cue = "{one.cue}"']
    for name in ("there", "missing"):
        if getattr(one, name):
            features = ", ".join(f'"{feature}"' for feature in getattr(one, name))
            parts.append(f"{name} = [{features}]")
    parts += [f"{name} = {list(getattr(one, name))}" for name in ("first", "stays", "appears")]
    return f"{{ {', '.join(parts)} }}"
