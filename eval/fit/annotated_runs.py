"""Training data from runs and their truth: annotated approaches and annotated drives.

For the fit of messages, a run's approach is matched to the true approach with the largest overlap
in time before the intersection. An approach without a match leads to no intersection, and to no
road to the left or right (a road straight ahead is unknown). For the fit of the belief over time, a
drive is divided into one part before each intersection of the truth, and parts with no intersection
ahead. Both exclude frames in an intersection or outside the truth's time.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from crosscue.datasets.truth.truth import Truth
from crosscue.eval.pipeline.run import Run, run_given
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.tables.travelled import odometer_of
from crosscue.eval.scoring.columns import NONE
from crosscue.eval.scoring.places import group_places
from crosscue.eval.scoring.runs import refuse_own_map
from crosscue.eval.scoring.truth import CROSSING_NS, DriveTruth, read_scored_truth
from crosscue.fusion.factor_graph import FactorGraph, graph_of
from crosscue.fusion.fit.annotated_approach import NOT_EVALUATED, AnnotatedApproach
from crosscue.fusion.fit.temporal_fit import AnnotatedDrive
from crosscue.fusion.intersection_range import Reference
from crosscue.fusion.temporal import MeasuredRange, ranges_to_start
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import RunError, UsageError
from crosscue.replay.progress import Progress, emit
from crosscue.replay.vehicle.vehicle import RangeCurve, Vehicle

# Min fraction of the time between two frames that odometry must cover.
COVERED: Final = 0.9
NOTHING_THERE: Final = {"intersection": False, "left": False, "right": False}
CURVES: Final = {Reference.START: "stop_sign", Reference.END: "traffic_light"}


Part = TypeVar("Part", AnnotatedApproach, AnnotatedDrive)


def read_annotated(
    runs: Sequence[Run | Path | str],
    truth: Sequence[Path | str],
    parts_of: Callable[[RunFolder, DriveTruth, Vehicle], Iterable[Part]],
) -> tuple[FactorGraph, list[Part]]:
    """Return the factor graph that all runs share, and their annotated parts, grouped by place.

    Raises:
        UsageError: The numbers of runs and truth files, or the factor graphs, differ.
        RunError: A run is damaged.
        AnnotationError: A truth file is not valid.
    """
    if len(runs) != len(truth):
        raise UsageError(
            f"truth: {len(runs)} runs, {len(truth)} truth files; give one for each, in the same "
            "order"
        )
    folders = [run_given(one).folder for one in runs]
    graph, vehicle = graph_of_runs(folders)
    parts: list[Part] = []
    for done, (folder, known) in enumerate(zip(folders, truth, strict=True), 1):
        one = read_scored_truth(Path(known), str(folder.path))
        refuse_own_map(folder, one.truth, Path(known))
        parts += parts_of(folder, one, vehicle)
        emit(Progress("reading", done, len(folders), "runs"))
    return graph, by_place(parts)


def by_place(parts: Sequence[Part]) -> list[Part]:
    """Return the parts with one name for each place, as in scores."""
    names: dict[int, str] = {}
    numbers = group_places([one.place for one in parts]).tolist()
    return [
        replace(one, place=names.setdefault(number, one.place))
        for number, one in zip(numbers, parts, strict=True)
    ]


def graph_of_runs(runs: Sequence[RunFolder]) -> tuple[FactorGraph, Vehicle]:
    """Return the factor graph that all runs share, and the settings of the first run.

    Raises:
        UsageError: The factor graphs differ.
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


def annotated_approaches(
    run: RunFolder, known: DriveTruth, vehicle: Vehicle, used: Counter[str]
) -> Iterator[AnnotatedApproach]:
    """Yield the approaches of one run to fit to, and count all by kind in ``used``.

    Raises:
        RunError: A table is missing or damaged, or the run is outside the truth's time.
    """
    run.refuse_set_back("fit messages")
    truth = known.truth
    belief = run.table("belief", ["t_ns", "approach", "established"])
    t_ns = _int64s(belief["t_ns"])
    number, established = _int64s(belief["approach"]), np.asarray(belief["established"])
    if len(t_ns) and not known.is_annotated(t_ns).any():
        raise RunError(
            f"{run.path}: no approach between {truth.start_ns} and {truth.end_ns} ns, which the "
            "truth covers; give the truth of this drive"
        )
    way_m = _distances(run, t_ns, vehicle)
    near = _near(run, t_ns, vehicle)
    counts = _counts_at(run.table("cues", ["t_ns", "cue", "count"]), t_ns)
    for one in np.unique(number).tolist():
        rows = np.flatnonzero(number == one)
        kept, features, at, what = _annotation_of(t_ns[rows], truth)
        used[what] += 1
        if features is None or not kept.any():
            continue
        rows = rows[kept]
        before = np.concatenate([[False], established[number == one][:-1]])[kept]
        yield AnnotatedApproach(
            way_m[rows] - way_m[rows[0]],
            (t_ns[rows] - t_ns[rows[0]]) * 1e-9,
            near[rows],
            before.astype(np.bool_),
            {cue: column[rows] for cue, column in counts.items()},
            features,
            known.places.get(at, f"{run.path}, approach {one}"),
        )


def _annotation_of(
    t_ns: Int64s, truth: Truth
) -> tuple[NDArray[np.bool_], dict[str, bool] | None, int, str]:
    """Return the frames to use, the true features, the true approach, and the approach's kind."""
    shared = [((t_ns >= a.start_ns) & (t_ns < a.enter_ns)).sum() for a in truth.approaches]
    if shared and max(shared) > 0:
        one = truth.approaches[int(np.argmax(shared))]
        features = {"intersection": True, **one.features.model_dump()}
        before = (t_ns >= one.start_ns) & (t_ns < one.enter_ns)
        if None in features.values():
            return before, None, NONE, "to an intersection with unknown roads, left out"
        return before, features, one.id, "to an intersection"
    inside = (t_ns >= truth.start_ns) & (t_ns < truth.end_ns)
    for a in truth.approaches:
        if ((t_ns >= a.enter_ns) & (t_ns < a.enter_ns + CROSSING_NS)).any():
            return inside, None, NONE, "in an intersection, left out"
    if not inside.all():
        return inside, None, NONE, "outside the truth's time, left out"
    return inside, dict(NOTHING_THERE), NONE, "to nothing"


def _int64s(column: object) -> Int64s:
    return np.asarray(column, np.int64)


def _distances(run: RunFolder, t_ns: Int64s, vehicle: Vehicle) -> Floats:
    """Return the distance travelled in either direction up to each sorted time.

    Gaps in the odometry count with the speed ``range_filter.unseen_mps``.
    """
    odometer = odometer_of(run)
    gone, total, last_ns = np.empty(len(t_ns)), 0.0, None
    for i, now_ns in enumerate(t_ns.tolist()):
        way = odometer.until(now_ns)
        gap_ns = 0 if last_ns is None else now_ns - last_ns
        is_known = way.covered_ns >= COVERED * gap_ns
        assumed_m = vehicle.range_filter.unseen_mps * gap_ns * 1e-9
        total += abs(way.distance_m) if is_known else assumed_m
        gone[i], last_ns = total, now_ns
    return gone


def _near(run: RunFolder, t_ns: Int64s, vehicle: Vehicle) -> NDArray[np.bool_]:
    """Return the frames in which the range was within the reach of the rule for dissent."""
    table = run.table("range", ["t_ns", "reference", "range_m"])
    at, reference = _int64s(table["t_ns"]), np.array(table["reference"].to_pylist(), np.str_)
    range_m = np.asarray(table["range_m"], np.float64)
    best = np.full(len(t_ns), np.inf)
    is_wanted = reference == vehicle.fusion.reference
    for rows in (~is_wanted, is_wanted):
        where, found = _indices_of(t_ns, at[rows])
        best[where] = range_m[rows][found]
    return np.asarray(best <= vehicle.fusion.dissent_within_m)


def annotated_drives(
    run: RunFolder,
    truth: DriveTruth,
    vehicle: Vehicle,
    tables: Mapping[str, pa.Table] | None = None,
) -> Iterator[AnnotatedDrive]:
    """Yield the parts of one run.

    Args:
        run: A run with finished stages.
        truth: Truth of the drive.
        vehicle: Range curves, and the distance over which ranges fade.
        tables: Tables ``cues`` and ``range``, if estimated with other settings; default: the run's.

    Raises:
        RunError: A table is missing or damaged.
    """
    run.refuse_set_back("fit temporal")
    if tables is None:
        columns = ["t_ns", "reference", "range_m", "var_m2", "measured_m"]
        tables = {
            "cues": run.table("cues", ["t_ns", "cue", "count"]),
            "range": run.table("range", columns),
        }
    t_ns = np.asarray(run.table("frames", ["t_ns"])["t_ns"], np.int64)
    moves = _moves(run, t_ns)
    counts = _counts_at(tables["cues"], t_ns)
    ranges = _ranges(tables["range"], t_ns, moves[0], vehicle)
    start_m = truth.start_m(t_ns)
    for kept, features, at in _parts(truth.truth, t_ns):
        rows = np.flatnonzero(kept)
        if not len(rows):
            continue
        since_first = moves[:, rows]
        since_first[:, 0] = 0.0
        way_m, var_m2, seconds = since_first
        yield AnnotatedDrive(
            way_m,
            var_m2,
            seconds,
            start_m[rows] if features["intersection"] else np.full(len(rows), np.nan),
            {cue: column[rows] for cue, column in counts.items()},
            tuple(ranges[i] for i in rows.tolist()),
            features,
            truth.places.get(at, str(run.path)),
        )


def _parts(truth: Truth, t_ns: Int64s) -> Iterator[tuple[NDArray[np.bool_], dict[str, bool], int]]:
    """Yield the frames of each part, its true features, and the id of the approach or ``NONE``."""
    ahead = np.zeros(len(t_ns), np.bool_)
    for one in truth.approaches:
        kept = (t_ns >= one.start_ns) & (t_ns < one.enter_ns)
        ahead |= kept | ((t_ns >= one.enter_ns) & (t_ns < one.enter_ns + CROSSING_NS))
        known = {
            name: value for name, value in one.features.model_dump().items() if value is not None
        }
        yield kept, {"intersection": True, **known}, one.id
    rest = ~ahead & (t_ns >= truth.start_ns) & (t_ns < truth.end_ns)
    edges = np.flatnonzero(np.diff(rest.astype(np.int8), prepend=0, append=0))
    for begin, end in edges.reshape(-1, 2).tolist():
        kept = np.zeros(len(rest), np.bool_)
        kept[begin:end] = True
        yield kept, dict(NOTHING_THERE), NONE


def _moves(run: RunFolder, t_ns: Int64s) -> Floats:
    """Return distance, its variance, and time since the previous frame, shape (3, N)."""
    odometer = odometer_of(run)
    steps = [odometer.until(now) for now in t_ns.tolist()]
    columns = [step.distance_m for step in steps], [step.var_m2 for step in steps]
    return np.array([*columns, np.diff(t_ns, prepend=t_ns[:1]) * 1e-9])


def _ranges(
    table: pa.Table, t_ns: Int64s, way_m: Floats, vehicle: Vehicle
) -> list[tuple[MeasuredRange, ...]]:
    """Return the measured ranges of each frame, in the filter's form."""
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
    """Return the variance of a measurement: its curve's, or the belief's if it has no curve."""
    curve: RangeCurve | None = getattr(vehicle.ranges, CURVES[reference])
    own = believed_m2 if curve is None else curve.residual_sd_m**2
    return own + (vehicle.range_filter.sd_fraction * range_m) ** 2


def _counts_at(table: pa.Table, t_ns: Int64s) -> dict[str, Int64s]:
    """Return the counts of each cue at sorted times, or ``NOT_EVALUATED``."""
    at, count = np.asarray(table["t_ns"], np.int64), np.asarray(table["count"], np.int64)
    cue = np.array(table["cue"].to_pylist(), np.str_)
    out: dict[str, Int64s] = {}
    for name in np.unique(cue).tolist():
        column = np.full(len(t_ns), NOT_EVALUATED, np.int64)
        where, found = _indices_of(t_ns, at[cue == name])
        column[where] = count[cue == name][found]
        out[name] = column
    return out


def _indices_of(t_ns: Int64s, at: Int64s) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the indices in the sorted ``t_ns`` of the times ``at``, and which of them occur."""
    where = np.searchsorted(t_ns, at)
    found = np.zeros(len(at), np.bool_)
    inside = where < len(t_ns)
    found[inside] = t_ns[where[inside]] == at[inside]
    return where[found], found
