"""Truth of a drive at given times: the approach, the range, and the visible cues."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.datasets.truth import truth as truth_file
from crosscue.datasets.truth.coco import read_coco
from crosscue.datasets.truth.csv_rows import csv_rows
from crosscue.datasets.truth.truth import Approach, CueTruth, Truth, read_truth
from crosscue.datasets.truth.tum import read_tum
from crosscue.detectors.overlay import TrueMarks
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.moments import frame_times
from crosscue.replay.columns import ColumnSet, Floats, Int64s
from crosscue.replay.errors import AnnotationError
from crosscue.replay.vehicle.cue_table import CUES

from .columns import NONE
from .places import places_of

# Max time between a moment and the true ranges it is interpolated from.
NEAREST_NS: Final = 500_000_000
# Time after entering during which the car is assumed to be in the intersection. Nothing is judged
# in this time.
CROSSING_NS: Final = 10_000_000_000
FEATURES: Final = ("intersection", "left", "right", "straight")


@dataclass(frozen=True, slots=True, eq=False)
class TrueRanges(ColumnSet):
    """N true ranges of the rear axle, sorted by time.

    Attributes:
        t_ns: Shape (N,).
        approach: Shape (N,): ids of approaches.
        start_m: Shape (N,): range to the start of the intersection, along the path.
        end_m: Shape (N,): range to its end; NaN where unknown.
    """

    t_ns: Int64s
    approach: Int64s
    start_m: Floats
    end_m: Floats

    def at(self, t_ns: Int64s, approach: Int64s) -> tuple[Floats, Floats]:
        """Return ranges to start and end, shape (M,) each; NaN without a true range near in time.

        Args:
            t_ns: Shape (M,).
            approach: Shape (M,): approach that the ranges must belong to.
        """
        start, end = np.full(len(t_ns), math.nan), np.full(len(t_ns), math.nan)
        for one in np.unique(approach[approach != NONE]).tolist():
            rows, asked = self.approach == one, approach == one
            if rows.any():
                known, when = self.t_ns[rows], t_ns[asked]
                start[asked] = _between(when, known, self.start_m[rows])
                end[asked] = _between(when, known, self.end_m[rows])
        return start, end


def _between(when: Int64s, known: Int64s, values: Floats) -> Floats:
    """Interpolate linearly, and extrapolate past the ends; NaN far in time from any value."""
    after = np.clip(np.searchsorted(known, when), 1, max(len(known) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(known) - 1)
    step = (known[after] - known[before]).astype(np.float64)
    gone = (when - known[before]).astype(np.float64)
    part = np.divide(gone, step, out=np.zeros(len(when)), where=step > 0)
    found = values[before] + part * (values[after] - values[before])
    off = np.minimum(np.abs(when - known[before]), np.abs(when - known[after]))
    return np.where(off <= NEAREST_NS, found, math.nan)


@dataclass(frozen=True, slots=True, eq=False)
class DriveTruth:
    """The truth of one drive.

    Attributes:
        drive: Name of the drive in results.
        truth: Contents of the truth file.
        ranges: True ranges; None if the truth has neither ranges nor a track.
        places: Place by id of the approach, and of the drive by ``NONE``, where known.
    """

    drive: str
    truth: Truth
    ranges: TrueRanges | None
    places: Mapping[int, str] = field(default_factory=dict)

    def approach_at(self, t_ns: Int64s) -> Int64s:
        """Return the ids of the current approaches, shape (N,); ``NONE`` outside approaches."""
        found = np.full(len(t_ns), NONE, np.int64)
        for one in self.truth.approaches:
            found[(t_ns >= one.start_ns) & (t_ns < one.enter_ns)] = one.id
        return found

    def is_crossing(self, t_ns: Int64s) -> np.typing.NDArray[np.bool_]:
        """Return True where the car has just entered an intersection, before the next approach."""
        found = np.zeros(len(t_ns), np.bool_)
        for one in self.truth.approaches:
            found |= (t_ns >= one.enter_ns) & (t_ns < one.enter_ns + CROSSING_NS)
        found &= self.approach_at(t_ns) == NONE
        return found

    def is_annotated(self, t_ns: Int64s) -> np.typing.NDArray[np.bool_]:
        """Return True where the truth covers a time."""
        return np.asarray((t_ns >= self.truth.start_ns) & (t_ns < self.truth.end_ns))

    def start_m(self, t_ns: Int64s) -> Floats:
        """Return ranges to the start of the intersection ahead; NaN where unknown."""
        if self.ranges is None:
            return np.full(len(t_ns), math.nan)
        return self.ranges.at(t_ns, self.approach_at(t_ns))[0]

    def approach(self, number: int) -> Approach:
        """Return the approach of an id."""
        return next(one for one in self.truth.approaches if one.id == number)


def read_scored_truth(path: Path, drive: str) -> DriveTruth:
    """Read a truth file and its ranges.

    Ranges are read from its CSV file or, without one, computed along its track.

    Raises:
        AnnotationError: A file is not valid.
        LogError: The trajectory cannot be read.
    """
    truth = truth_file.read_truth(path)
    folder = path if path.is_dir() else path.parent
    ranges = None
    if truth.ranges is not None:
        ranges = _read_ranges(folder / truth.ranges, truth)
    elif truth.pose is not None and truth.approaches:
        ranges = _ranges_along(folder / truth.pose, truth)
    return DriveTruth(drive, truth, ranges, places_of(truth, folder))


def _read_ranges(path: Path, truth: Truth) -> TrueRanges:
    known = {one.id for one in truth.approaches}
    remedy = "the truth names it under ranges"
    table = csv_rows(path, "t_ns,approach,start_m,end_m", remedy=remedy)
    rows = sorted(_range_row(row, known, where) for where, row in table)
    t_ns, approach, start, end = zip(*rows, strict=True) if rows else ((), (), (), ())
    return TrueRanges(
        np.array(t_ns, np.int64),
        np.array(approach, np.int64),
        np.array(start, np.float64),
        np.array(end, np.float64),
    )


def _range_row(row: dict[str, str], known: set[int], where: str) -> tuple[int, int, float, float]:
    try:
        t_ns, approach = int(row["t_ns"]), int(row["approach"])
        start_m = float(row["start_m"])
        end_m = float(row["end_m"]) if row["end_m"] else math.nan
    except (TypeError, ValueError):
        raise AnnotationError(
            f"{where}: expected integers for t_ns and approach, and numbers in metres"
        ) from None
    if not math.isfinite(start_m) or math.isinf(end_m) or not -(2**62) < t_ns < 2**62:
        raise AnnotationError(f"{where}: expected finite numbers")
    if approach not in known:
        raise AnnotationError(f"{where}: no approach {approach}; there are: {sorted(known)}")
    return t_ns, approach, start_m, end_m


def _ranges_along(path: Path, truth: Truth) -> TrueRanges:
    """Return ranges as the remaining distance along the true track until the rear axle enters."""
    track = read_tum(path)
    steps = np.linalg.norm(np.diff(track.xyz_m[:, :2], axis=0), axis=1)
    gone = np.concatenate([[0.0], np.cumsum(steps)])
    empty = np.empty(0, np.int64)
    found = TrueRanges(empty, empty, np.empty(0), np.empty(0))
    for one in truth.approaches:
        inside = (track.t_ns >= one.start_ns) & (track.t_ns <= one.enter_ns)
        enter_m = _between(np.array([one.enter_ns]), track.t_ns, gone)[0]
        if not inside.any() or math.isnan(enter_m):
            continue
        start = enter_m - gone[inside]
        end = start + (math.nan if one.length_m is None else one.length_m)
        ids = np.full(len(start), one.id, np.int64)
        found += TrueRanges(track.t_ns[inside], ids, start, end)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class CueTruthAt:
    """Truth about one cue at M times.

    Attributes:
        present: Shape (M,), int8: 1 present, 0 absent, ``NONE`` unknown.
        count: Shape (M,): number of objects; ``NONE`` unknown.
        visible: Shape (M,): visible fraction of the most visible object; NaN unknown.
    """

    present: np.typing.NDArray[np.int8]
    count: Int64s
    visible: Floats


def cue_at(spans: list[CueTruth], t_ns: Int64s) -> CueTruthAt:
    """Return the truth at given times from the spans and moments of one cue.

    Where two spans overlap, presence has precedence over absence, because they describe two
    objects.
    """
    present = np.full(len(t_ns), NONE, np.int8)
    count = np.full(len(t_ns), NONE, np.int64)
    visible = np.full(len(t_ns), math.nan)
    order = np.argsort(t_ns, kind="stable")
    in_order = t_ns[order]
    for span in sorted(spans, key=lambda span: span.present):
        first = span.t_ns if span.start_ns is None else span.start_ns
        assert first is not None
        last = first + 1 if span.end_ns is None else span.end_ns
        low, high = np.searchsorted(in_order, [first, last])
        rows = order[low:high]
        present[rows] = int(span.present)
        reported = (0 if not span.present else NONE) if span.count is None else span.count
        count[rows] = reported
        visible[rows] = math.nan if span.visible is None else span.visible
    return CueTruthAt(present, count, visible)


def has_feature(approach: Approach, feature: str) -> bool | None:
    """Return whether an approach's intersection has a feature; None if the truth is unknown."""
    if feature == "intersection":
        return True
    there = {
        "left": approach.features.left,
        "right": approach.features.right,
        "straight": approach.features.straight,
    }
    return there.get(feature)


def true_marks(truth: Path, run: RunFolder, wanted: Collection[int]) -> Mapping[int, TrueMarks]:
    """Return the labelled boxes and present cues by time in the run's tables.

    Raises:
        SchemaError: The truth or its boxes cannot be read.
    """
    found = read_truth(truth)
    moved = frame_times(run)
    logged = {t_ns: log_ns for log_ns, t_ns in moved.items() if t_ns in wanted}
    times = {logged.get(t_ns, t_ns): t_ns for t_ns in sorted(wanted)}
    boxes: dict[int, list[tuple[str, tuple[float, float, float, float]]]] = {}
    pictures = () if found.objects is None else read_coco(truth.parent / found.objects).pictures
    for one in pictures:
        if one.t_ns in times:
            boxes[times[one.t_ns]] = [
                (thing.label, thing.box_px) for thing in one.things if thing.box_px is not None
            ]
    log_ns = np.array([*times], np.int64)
    counts: dict[int, dict[str, int]] = {}
    for cue in dict.fromkeys(one.cue for one in found.cues):
        if cue in CUES and CUES[cue].observed_by == "map":
            continue  # its legs are those of the road cues, and no picture shows a map
        at = cue_at([one for one in found.cues if one.cue == cue], log_ns)
        for row in np.flatnonzero(at.present == 1).tolist():
            number = max(int(at.count[row]), 1)
            counts.setdefault(times[int(log_ns[row])], {})[cue] = number
    return {t: TrueMarks(boxes.get(t, ()), counts.get(t, {})) for t in times.values()}
