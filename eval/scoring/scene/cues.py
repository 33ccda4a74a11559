"""Precision, recall and coverage of cues, compared with truth.

Positives are judged by two criteria, and both are reported:

* *object*: the object that the cue names is present in this frame (a parked car facing left, a
  stop sign, road to the left);
* *feature*: the feature that the cue supports is true of the intersection ahead (a left turn, an
  intersection); for one-way and do-not-enter signs, the direction that they exclude is closed.

The dissertation compares signs, lights and cars with objects, and roads, lanes and vehicles past
the intersection with the direction of travel (chapter 3). The table of cues records the criterion
of each cue. If the truth supports only the other criterion, that one leads, and the result reports
it. If the truth has some objects, those that it does not name are unknown: the features of the
intersection then are no evidence about them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.scoring.columns import AMBIGUOUS, NONE, CueRows, RunTables
from crosscue.eval.scoring.intervals import Proportion, fraction
from crosscue.eval.scoring.places import cluster_numbers
from crosscue.eval.scoring.pooling import BINS_M, distance_bins, first_reasons, sum_counts
from crosscue.eval.scoring.truth import FEATURES, DriveTruth, cue_at, has_feature
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.vehicle.vehicle import CUES, Scoring

Reading = Scoring


# Min visible fraction of an object that counts in ``recall_seen``.
SEEN: Final = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class CueFrames:
    """One cue in N frames of one drive, compared with truth.

    Attributes:
        drive: Name of the drive.
        cue: Name of the cue.
        t_ns: Shape (N,): times of the frames in which the cue was searched.
        count: Shape (N,): number found.
        approach: Shape (N,): ids of true approaches; ``NONE`` outside.
        distance_m: Shape (N,): true range to the start of the intersection; NaN unknown.
        is_object: Shape (N,), int8: 1 if the object is present, 0 if not; ``NONE`` unknown.
        is_feature: Shape (N,), int8: 1 if the supported feature is true, 0 if not; ``NONE``
            unknown.
        true_count: Shape (N,): true number of objects; ``NONE`` unknown.
        visible: Shape (N,): visible fraction; NaN unknown.
        frames: Number of frames of the run.
        moments_unmatched: Number of true moments (not spans) without a frame of the run.
        left_out: Numbers of unscored frames by criterion and reason.
        conditions: Tags by id of the approach.
        is_open: True if the truth has other objects but not this one.
        places: Place by id of the approach.
    """

    drive: str
    cue: str
    t_ns: Int64s
    count: Int64s
    approach: Int64s
    distance_m: Floats
    is_object: NDArray[np.int8]
    is_feature: NDArray[np.int8]
    true_count: Int64s
    visible: Floats
    frames: int
    moments_unmatched: int
    left_out: Mapping[Reading, Mapping[str, int]]
    conditions: Mapping[int, tuple[str, ...]]
    is_open: bool = False
    places: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class CueMetrics:
    """Metrics of one cue by one criterion.

    Attributes:
        frames: Number of frames in the run.
        with_truth: Number of frames with truth.
        scored: Number of frames with truth in which the cue was searched.
        left_out: Number of frames by reason; with ``scored``, they sum up to ``frames``.
        positives: Number of scored frames in which the cue was found.
        precision: Fraction of correct positives.
        recall: Fraction of frames with the object in which it was found; None for features.
        recall_seen: Recall of objects that are at least half visible.
        by_distance: Precision and recall by true range to the intersection, such as ``10-20``.
        by_condition: Precision and recall by condition tag of the approach.
    """

    frames: int
    with_truth: int
    scored: int
    left_out: dict[str, int]
    positives: int
    precision: Proportion
    recall: Proportion | None
    recall_seen: Proportion | None
    by_distance: dict[str, CuePartMetrics]
    by_condition: dict[str, CuePartMetrics]


@dataclass(frozen=True, slots=True)
class CuePartMetrics:
    """Metrics of the frames in a distance bin or with a condition tag."""

    frames: int
    precision: Proportion
    recall: Proportion | None


@dataclass(frozen=True, slots=True)
class Things:
    """Counts of objects over all frames whose true count is known.

    Attributes:
        frames: Number of frames with a true count.
        reported: Number of objects found.
        true: Number of true objects.
        matched: Sum over frames of the smaller number, an upper bound of correct objects.
        same_count: Number of frames in which both numbers agree.
    """

    frames: int
    reported: int
    true: int
    matched: int
    same_count: int


@dataclass(frozen=True, slots=True)
class CueScore:
    """Scores of one cue.

    Attributes:
        reading: The leading criterion, ``object`` or ``feature``.
        is_sources_reading: True if that is the dissertation's criterion.
        precision: Precision by the leading criterion.
        recall: Recall of objects; None without truth of objects.
        positives: Number of positives by the leading criterion.
        scored: Number of scored frames by the leading criterion.
        readings: Metrics by both criteria.
        things: Counts of objects.
        moments_unmatched: Number of true moments without a frame of any run.
    """

    reading: Reading
    is_sources_reading: bool
    precision: Proportion
    recall: Proportion | None
    positives: int
    scored: int
    readings: dict[Reading, CueMetrics]
    things: Things
    moments_unmatched: int


def match_cues(tables: RunTables, truth: DriveTruth) -> list[CueFrames]:
    """Compare the run's cues with the truth; empty for a run without cues."""
    if tables.cues is None:
        return []
    rows = tables.cues
    frames = np.unique(rows.t_ns)
    if tables.frames_ns is not None:
        frames = np.union1d(frames, tables.frames_ns)
    stated = {one.cue for one in truth.truth.cues}
    others = sorted({*np.unique(rows.cue).tolist(), *stated} - {*CUES})
    ambiguous = tables.ambiguous.get("frames", 0)
    return [_judge(cue, rows, frames, truth, ambiguous) for cue in (*CUES, *others)]


def features_not_looked_for(tables: RunTables) -> frozenset[str]:
    """Return the features of an intersection that no cue of the run could show or exclude.

    A cue that the table of cues does not know may stand for any feature. A run without a table of
    cues does not state what was looked for, so nothing is returned.
    """
    if tables.cues is None:
        return frozenset()
    looked = np.unique(tables.cues.cue).tolist()
    if any(cue not in CUES for cue in looked):
        return frozenset()
    shown = {name for cue in looked for name in (*CUES[cue].supports, *CUES[cue].excludes)}
    return frozenset(FEATURES) - shown


def _judge(cue: str, rows: CueRows, frames: Int64s, truth: DriveTruth, ambiguous: int) -> CueFrames:
    looked, count = _largest(rows, cue)
    spans = [one for one in truth.truth.cues if one.cue == cue]
    is_object = cue in CUES and CUES[cue].scored_as == "object"
    everywhere = cue_at(spans, frames)
    features = _feature_at(cue, frames, truth)
    at = np.searchsorted(frames, looked)
    was_looked = np.zeros(len(frames), np.bool_)
    was_looked[at] = True
    stated, crossing = truth.is_annotated(frames), truth.is_crossing(frames)
    twice = {AMBIGUOUS: ambiguous} if ambiguous else {}
    moments = np.array([one.t_ns for one in spans if one.t_ns is not None], np.int64)
    return CueFrames(
        drive=truth.drive,
        cue=cue,
        t_ns=looked,
        count=count,
        approach=truth.approach_at(looked),
        distance_m=truth.start_m(looked),
        is_object=everywhere.present[at],
        is_feature=features[at],
        true_count=everywhere.count[at],
        visible=everywhere.visible[at],
        frames=len(frames) + ambiguous,
        moments_unmatched=int((~np.isin(moments, frames)).sum()),
        left_out={
            "object": twice | _reasons(everywhere.present != NONE, was_looked, stated, crossing),
            "feature": twice | _reasons(features != NONE, was_looked, stated, crossing),
        },
        conditions={one.id: one.conditions for one in truth.truth.approaches},
        is_open=bool(truth.truth.cues) and not spans and is_object,
        places=truth.places,
    )


def _largest(rows: CueRows, cue: str) -> tuple[Int64s, Int64s]:
    """Return the distinct times at which a cue was searched, and the largest count of each."""
    mine = rows.cue == cue
    times, which = np.unique(rows.t_ns[mine], return_inverse=True)
    count = np.zeros(len(times), np.int64)
    np.maximum.at(count, which, rows.count[mine])
    return times, count


def _feature_at(cue: str, t_ns: Int64s, truth: DriveTruth) -> NDArray[np.int8]:
    """Return whether the feature of the cue is true at each time; ``NONE`` unknown."""
    found = np.full(len(t_ns), NONE, np.int8)
    if cue not in CUES or not truth.truth.approaches:
        return found
    # Where the truth has no intersection ahead, the feature of any cue is false.
    found[truth.is_annotated(t_ns)] = 0
    found[truth.is_crossing(t_ns)] = NONE
    at = truth.approach_at(t_ns)
    feature, is_there = CUES[cue].claim
    for one in truth.truth.approaches:
        there = has_feature(one, feature)
        found[at == one.id] = NONE if there is None else int(there == is_there)
    return found


def _reasons(
    has_truth: NDArray[np.bool_],
    was_looked: NDArray[np.bool_],
    is_annotated: NDArray[np.bool_],
    is_crossing: NDArray[np.bool_],
) -> dict[str, int]:
    """Return numbers of unscored frames by reason; the first reason that applies counts."""
    reasons = {
        "outside the truth's time": ~is_annotated & ~has_truth,
        "in the intersection": is_crossing & ~has_truth,
        "no truth at this time": ~has_truth,
        "not looked for": ~was_looked,
    }
    return first_reasons(np.ones(len(has_truth), np.bool_), reasons)[1]


def is_wrong(cue: CueFrames) -> NDArray[np.bool_]:
    """Return the rows in which the cue was found but is false by the leading criterion."""
    readings = [cue.is_object, cue.is_feature]
    if cue.cue in CUES and CUES[cue.cue].scored_as == "feature":
        readings.reverse()
    leading = next((one for one in readings if (one != NONE).any()), readings[0])
    return np.asarray((cue.count > 0) & (leading == 0))


@dataclass(frozen=True, slots=True, eq=False)
class _Pooled:
    """Rows of one cue of all drives, with the number of the place of each row."""

    rows: Sequence[CueFrames]
    cluster: Int64s

    def tag_masks(self) -> dict[str, NDArray[np.bool_]]:
        """Return masks of the rows by tag of the approach; ``no tag`` for the others."""
        tags = [
            one.conditions.get(approach, ())
            for one in self.rows
            for approach in one.approach.tolist()
        ]
        names = sorted({name for some in tags for name in some})
        has = {name: [name in some for some in tags] for name in names}
        has["no tag"] = [not some for some in tags]
        return {name: np.array(holds, np.bool_) for name, holds in has.items()}

    def column(self, name: str) -> NDArray[Any]:
        return np.concatenate([getattr(one, name) for one in self.rows])


def score_cues(
    judged: Sequence[CueFrames], bins_m: Sequence[float] = BINS_M
) -> dict[str, CueScore]:
    """Return scores by cue, over all drives together.

    Args:
        judged: Results of ``match_cues``, of any number of drives.
        bins_m: Edges of distance bins.
    """
    by_cue: dict[str, list[CueFrames]] = {}
    for one in judged:
        by_cue.setdefault(one.cue, []).append(one)
    return {cue: _score(cue, rows, bins_m) for cue, rows in by_cue.items()}


def _score(cue: str, rows: Sequence[CueFrames], bins_m: Sequence[float]) -> CueScore:
    pooled = _Pooled(rows, cluster_numbers(rows))
    readings: dict[Reading, CueMetrics] = {
        reading: _judgement(pooled, reading, bins_m) for reading in ("object", "feature")
    }
    wanted: Reading = CUES[cue].scored_as if cue in CUES else "object"
    other: Reading = "feature" if wanted == "object" else "object"
    is_open = all(one.is_open for one in rows)
    is_wanted = readings[wanted].scored or not readings[other].scored or is_open
    leading = wanted if is_wanted else other
    return CueScore(
        reading=leading,
        is_sources_reading=leading == wanted,
        precision=readings[leading].precision,
        recall=readings["object"].recall,
        positives=readings[leading].positives,
        scored=readings[leading].scored,
        readings=readings,
        things=_things(pooled),
        moments_unmatched=sum(one.moments_unmatched for one in rows),
    )


def _judgement(pooled: _Pooled, reading: Reading, bins_m: Sequence[float]) -> CueMetrics:
    truth = pooled.column("is_object" if reading == "object" else "is_feature")
    left_out = sum_counts(one.left_out[reading] for one in pooled.rows)
    frames = sum(one.frames for one in pooled.rows)
    known = truth != NONE
    cut = _Cut(truth, pooled.column("count") > 0, pooled.cluster, reading == "object")
    visible = pooled.column("visible")
    # An object of unknown visibility counts as seen.
    seen = known & ((truth == 0) | np.isnan(visible) | (visible >= SEEN))
    return CueMetrics(
        frames=frames,
        with_truth=frames - sum(n for why, n in left_out.items() if why != "not looked for"),
        scored=int(known.sum()),
        left_out=left_out,
        positives=int((known & cut.is_found).sum()),
        precision=cut.precision(known),
        recall=cut.recall(known),
        recall_seen=cut.recall(seen),
        by_distance={
            name: cut.part(known & mask)
            for name, mask in distance_bins(pooled.column("distance_m"), bins_m).items()
            if (known & mask).any()
        },
        by_condition={
            tag: cut.part(known & mask)
            for tag, mask in pooled.tag_masks().items()
            if (known & mask).any()
        },
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Cut:
    """Precision and recall over any subset of frames."""

    truth: NDArray[np.int8]
    is_found: NDArray[np.bool_]
    cluster: Int64s
    has_recall: bool

    def precision(self, rows: NDArray[np.bool_]) -> Proportion:
        rows = rows & self.is_found
        return fraction(self.truth[rows] == 1, self.cluster[rows])

    def recall(self, rows: NDArray[np.bool_]) -> Proportion | None:
        if not self.has_recall:
            return None
        rows = rows & (self.truth == 1)
        return fraction(self.is_found[rows], self.cluster[rows])

    def part(self, rows: NDArray[np.bool_]) -> CuePartMetrics:
        return CuePartMetrics(int(rows.sum()), self.precision(rows), self.recall(rows))


def _things(pooled: _Pooled) -> Things:
    true, found = pooled.column("true_count"), pooled.column("count")
    known = true != NONE
    true, found = true[known], found[known]
    return Things(
        frames=int(known.sum()),
        reported=int(found.sum()),
        true=int(true.sum()),
        matched=int(np.minimum(true, found).sum()),
        same_count=int((true == found).sum()),
    )
