"""Divide a drive into approaches to intersections, each with its ranges and its belief.

The dissertation scores one approach per run, but a drive has many. The life of an approach:

* It opens with the first evidence: a sign with a range, or a cue with ``can_start``. A neutral
  belief is therefore never old at the next intersection.
* It closes when the intersection's end is behind the rear axle (the measured end, or the start plus
  a typical length), when the car has turned at the intersection, or when the evidence is stale.
  Without any range, evidence becomes stale sooner, and the approach ends after ``longest_m``. Where
  the frames tell which roads begin ahead, it is passed once none of those seen does any more, and
  the next one opens if another comes up after one of them is gone; not while the car stands, nor
  while a light or sign is in view.
* It restarts if its first range shows that it opened too far away to belong to that intersection.
* If it closes before presence is established, it was noise: it counts as neutral, not as a
  detection.

Only signs with a range and cues with ``can_start`` keep evidence fresh, because road straight
ahead is seen everywhere. Staleness depends on distance, not on time, so the approach of a car that
waits at the stop line remains open. While it stands, a static cue is evidence only until it was
seen there once, unless it is worth more: a light may come into view, but looking on tells nothing
more. Only the published belief (``source``) counts every frame. Without odometry, the distance is
estimated with ``RangeFilter.unseen_mps``, which also widens the ranges; a range that is too wide is
dropped.
Only the published belief lets this distance end an approach whose evidence is still in view.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

from crosscue.fusion.situation import Situation
from crosscue.replay.vehicle.fusion import Fusion, RangeFilter

from .belief import (
    Belief,
    MessageModel,
    begin,
    establish,
    multiply,
    probabilities,
    published_message_model,
)
from .calibrated import CalibratedMessageModel, cue_messages_of
from .combined import CombinedFilter, CombinedModel
from .evidence import FrameEvidence, PastCues, RangePosterior, SignRange
from .factor_graph import FactorGraph
from .intersection_range import RangeBelief, Reference
from .persistence import Confirmed, Persistence, PersistentMessageModel
from .range_track import (
    NOTHING,
    RangeTrack,
    Verdict,
    advance_range,
    follow,
    fuse_range,
    predict_without_odometry,
)
from .temporal import (
    TemporalFilter,
    TemporalMessageModel,
    ranges_to_start,
    temporal_model,
    update_with,
)

# Distance over which an accumulated turn decays, so that bends of a road do not add up to one.
TURN_FADES_M: Final = 25.0
# Distance since the last evidence of static objects below which the car stands, as in
# ``Fusion.dissent_every_m``.
STANDING_M: Final = 0.1


@dataclass(frozen=True, slots=True)
class RangeRow:
    """A row of ``range.parquet``; ``measured_m`` is None without an accepted measurement."""

    reference: Reference
    range_m: float
    var_m2: float
    measured_m: float | None


@dataclass(frozen=True, slots=True)
class Step:
    """Belief after one frame.

    Attributes:
        t_ns: Log time of the evidence.
        approach: Number of the open approach; None outside approaches.
        counts: Counts of the evidence and of the cues past the intersection.
        ranges: One row for each reference with a belief.
        probabilities: Probability of each feature; empty outside approaches.
        established: True if the intersection's presence is established.
        not_believed: Reason for each positive cue that sent no message; only with persistence.
    """

    t_ns: int
    approach: int | None
    counts: Mapping[str, int]
    ranges: tuple[RangeRow, ...] = ()
    probabilities: Mapping[str, float] = field(default_factory=dict)
    established: bool = False
    not_believed: Mapping[str, str] = field(default_factory=dict)


def no_past_cues(best: RangeBelief | None, reference: Reference | None) -> Mapping[str, int]:
    """Return no counts, for a car without a Mobileye."""
    return {}


class _Moved(NamedTuple):
    """Distance travelled since the previous evidence, regardless of direction, and duration.

    Attributes:
        advanced_m: Signed distance, negative in reverse.
        is_standing: True if only moving objects count, and static ones not yet seen there.
    """

    way_m: float
    time_s: float
    advanced_m: float
    advanced_var_m2: float
    is_standing: bool = False


@dataclass(slots=True)
class _Open:
    """State of the open approach."""

    number: int
    belief: Belief
    model: MessageModel
    start: RangeTrack = NOTHING
    end: RangeTrack = NOTHING
    way_m: float = 0.0
    since_evidence_m: float = 0.0
    since_dissent_m: float = math.inf
    turned_rad: float = 0.0
    roads: frozenset[str] = frozenset()


class Approaches:
    """Processes evidence in time order; it holds all state of the estimation.

    Attributes:
        counts: Numbers of approaches opened, established and closed, and of rejected ranges and
            evidence, by reason.
    """

    def __init__(self, graph: FactorGraph, fusion: Fusion, range_filter: RangeFilter) -> None:
        self.counts: Counter[str] = Counter()
        self._graph = graph
        self._fusion = fusion
        self._filter = range_filter
        self._new_model = message_models_of(graph, fusion)
        self._over_drive = _over_drive(graph, fusion)
        self._first = tuple(cue.name for cue in graph.cues if cue.can_start)
        self._persistence = Persistence(graph) if fusion.kind == "persistent" else None
        self._open: _Open | None = None
        self._last_ns: int | None = None
        self._rest_m = 0.0
        self._since_range_m = math.inf
        self._since_static_m = math.inf
        self._static = frozenset(cue.name for cue in graph.cues if not cue.moves)
        self._is_published = fusion.kind in ("source", None)
        # Static cues that count no more until the car moves on, unless they are worth more.
        self._seen_here: dict[str, float] = {}

    def __call__(self, evidence: FrameEvidence, past: PastCues = no_past_cues) -> Step:
        """Process the next evidence; it is ignored if it is not later than the previous one."""
        if evidence.travelled_m == 0.0 and not self._is_published:
            # A car that stands does not turn, whatever the gyroscope's bias.
            evidence = replace(evidence, travelled_var_m2=0.0, turned_rad=None)
        moved = self._moved(evidence)
        if moved is None:
            return Step(evidence.t_ns, None, {})
        if self._open is not None:
            self._advance(self._open, evidence, moved.way_m)
        moved, looked_for = self._with_standing(moved), evidence.counts
        if moved.is_standing:
            moving = self._without_static(evidence.counts, moved, evidence.weights)
            evidence = replace(evidence, counts=moving, signs=(), posteriors=())
        step = self._judged(evidence, past, moved)
        return replace(step, counts={**looked_for, **step.counts})

    def _with_standing(self, moved: _Moved) -> _Moved:
        """Say whether the car stands, except for the published method, which counts all frames."""
        self._since_static_m += moved.way_m
        is_standing = self._since_static_m < STANDING_M and not self._is_published
        if not is_standing:
            self._since_static_m = 0.0
            self._seen_here.clear()
        return moved._replace(is_standing=is_standing)

    def _without_static(
        self, counts: Mapping[str, int], moved: _Moved, weights: Mapping[str, float]
    ) -> Mapping[str, int]:
        """Counts that are evidence: while the car stands, of moving objects and of what is new.

        The filter over a drive judges static cues by steps of distance only.
        """
        if not moved.is_standing:
            return counts
        known = self._static
        if self._over_drive is None:
            seen = self._seen_here.items()
            known = known & {cue for cue, weight in seen if weights.get(cue, 1.0) <= weight}
        return {cue: count for cue, count in counts.items() if cue not in known}

    def _judged(self, evidence: FrameEvidence, past: PastCues, moved: _Moved) -> Step:
        """Update the belief with what counts as evidence."""
        self._rest_m = max(0.0, self._rest_m - moved.way_m)
        self._since_range_m += moved.way_m
        signs = self._plausible(evidence.signs)
        ranged = {**signs, **{o.reference: (o.range_m, o.var_m2) for o in evidence.posteriors}}
        confirmed = self._confirmed(evidence.counts, evidence)
        can_open = any(confirmed.counts.get(cue, 0) > 0 for cue in self._first)
        if self._open is not None and _is_about_another(self._open, ranged, self._fusion.longest_m):
            self._close("another ahead")
        if self._open is not None:
            why = self._passed_roads(self._open, evidence, moved)
            if why is not None:
                self._close(why)
        if self._open is None and (ranged or (can_open and self._rest_m <= 0.0)):
            self._begin()
        if self._open is None:
            self._count_silent(confirmed.silent)
            if self._over_drive is not None:
                update_with(self._over_drive, self._situation(evidence, confirmed.counts, moved))
            return Step(evidence.t_ns, None, evidence.counts, not_believed=confirmed.silent)
        if ranged or can_open:
            self._open.since_evidence_m = 0.0
        self._open.roads |= {cue for cue, is_ahead in evidence.roads_ahead.items() if is_ahead}
        return self._step(self._open, evidence, confirmed, signs, past, moved)

    def _passed_roads(self, current: _Open, evidence: FrameEvidence, moved: _Moved) -> str | None:
        """Reason why an approach is over whose roads were seen, by the roads ahead now."""
        ahead = evidence.roads_ahead
        gone = [ahead.get(cue) is False for cue in current.roads]
        others = any(evidence.counts.get(cue, 0) > 0 for cue in self._first if cue not in ahead)
        if not any(gone) or moved.is_standing:
            return None
        if others or evidence.signs or evidence.posteriors:
            if all(gone) and isinstance(current.model, PersistentMessageModel):
                # The roads were those of a street before the intersection that is still ahead.
                undone = current.model.withdraw(current.roads | evidence.weights.keys())
                current.belief = multiply(current.belief, undone)
                current.roads = frozenset()
            return None
        if any(is_ahead and cue not in current.roads for cue, is_ahead in ahead.items()):
            return "another ahead"
        return "passed" if all(gone) else None

    def restart(self) -> None:
        """Restart after a gap in time, because the belief is about another place."""
        if self._open is not None:
            self._close("a gap in time")
        if self._persistence is not None:
            self._persistence.restart()
        self._over_drive = _over_drive(self._graph, self._fusion)
        self._last_ns = None
        self._rest_m = 0.0
        self._since_range_m = math.inf
        self._since_static_m = math.inf
        self._seen_here.clear()

    def finish(self) -> None:
        """End the drive; an open approach is counted as closed by it."""
        if self._open is not None:
            self._close("the drive ended")

    def _confirmed(self, counts: Mapping[str, int], evidence: FrameEvidence) -> Confirmed:
        """Counts that can be used: all, or the confirmed ones with persistence."""
        if self._persistence is None:
            confirmed = Confirmed(counts, {})
        else:
            confirmed = self._persistence(counts, is_new_picture=evidence.is_new_picture)
        for cue, count in confirmed.counts.items():
            if count > 0:
                weight = evidence.weights.get(cue, 1.0)
                self._seen_here[cue] = max(weight, self._seen_here.get(cue, 0.0))
        return confirmed

    def _count_silent(self, silent: Mapping[str, str]) -> None:
        self.counts.update(f"{cue} not believed: {why}" for cue, why in silent.items())

    def _moved(self, evidence: FrameEvidence) -> _Moved | None:
        """Distance, estimated where unknown, and duration; None for evidence that is rejected."""
        last_ns = self._last_ns
        if last_ns is not None and evidence.t_ns <= last_ns:
            why = "repeated" if evidence.t_ns == last_ns else "out of order"
            self.counts[f"evidence refused: {why}"] += 1
            return None
        self._last_ns = evidence.t_ns
        if last_ns is None:
            # A log can begin long before its first picture, so earlier motion is ignored.
            return _Moved(0.0, 0.0, 0.0, 0.0)
        passed_s = (evidence.t_ns - last_ns) * 1e-9
        if evidence.travelled_m is not None and _has_way(evidence):
            way_m, var_m2 = evidence.travelled_m, evidence.travelled_var_m2
            return _Moved(abs(way_m), passed_s, way_m, var_m2)
        self.counts["odometry missing"] += 1
        way_m = self._filter.unseen_mps * passed_s
        # The distance is unknown: its mean is half of the estimate, with that half as s.d.
        return _Moved(way_m, passed_s, 0.5 * way_m, 0.25 * way_m * way_m)

    def _advance(self, current: _Open, evidence: FrameEvidence, moved_m: float) -> None:
        """Predict the approach over the distance since the last evidence; close it if over."""
        had = (current.start.belief is not None) + (current.end.belief is not None)
        current.start = self._predicted(current.start, evidence, moved_m)
        current.end = self._predicted(current.end, evidence, moved_m)
        has = (current.start.belief is not None) + (current.end.belief is not None)
        if has < had:
            self.counts["ranges dropped: too uncertain"] += had - has
        if self._is_published or (evidence.travelled_m is not None and _has_way(evidence)):
            # An assumed distance ends no approach whose evidence is in view: the car may stand.
            current.way_m += moved_m
        current.since_evidence_m += max(moved_m - evidence.assumed_m, 0.0)
        current.since_dissent_m += moved_m
        if evidence.turned_rad is not None and math.isfinite(evidence.turned_rad):
            kept = current.turned_rad * math.exp(-moved_m / TURN_FADES_M)
            current.turned_rad = kept + evidence.turned_rad
        why = self._over(current)
        if why is not None:
            self._close(why)

    def _predicted(self, track: RangeTrack, evidence: FrameEvidence, moved_m: float) -> RangeTrack:
        if evidence.travelled_m is None or not _has_way(evidence):
            return predict_without_odometry(track, moved_m, self._filter)
        return advance_range(track, evidence.travelled_m, evidence.travelled_var_m2, self._filter)

    def _over(self, current: _Open) -> str | None:
        """Reason why the approach is over; None if it is not."""
        fusion, end_m = self._fusion, _end_m(current, self._fusion.length_m)
        if end_m is not None and end_m < -fusion.closes_behind_m:
            return "passed"
        if end_m is not None and end_m > self._filter.max_m + fusion.length_m:
            return "out of reach"
        is_at_it = end_m is None or end_m <= fusion.length_m
        if is_at_it and abs(current.turned_rad) >= fusion.turned_rad:
            return "turned"
        if end_m is None and current.way_m > fusion.longest_m:
            return "too long"
        limit_m = fusion.stale_unranged_m if end_m is None else fusion.stale_after_m
        return "stale" if current.since_evidence_m > limit_m else None

    def _begin(self) -> None:
        self.counts["approaches opened"] += 1
        number = self.counts["approaches opened"]
        model = (
            self._new_model()
            if self._over_drive is None
            else TemporalMessageModel(self._graph, self._over_drive)
        )
        self._open = _Open(number, begin(self._graph), model)

    def _close(self, why: str) -> None:
        is_real = self._open is not None and self._open.belief.is_established
        self.counts[f"approaches closed: {why if is_real else 'neutral'}"] += 1
        self._rest_m = self._fusion.rest_m if why in ("passed", "turned") else 0.0
        self._open = None

    def _plausible(self, signs: Sequence[SignRange]) -> dict[Reference, tuple[float, float]]:
        """Mean range and variance of each reference's signs; implausible ranges are rejected.

        The variance of the mean is that of one sign, because all share the curve's error.
        """
        found: dict[Reference, list[SignRange]] = {}
        for sign in signs:
            # An s.d. above the maximum range carries no information, and its square overflows.
            max_m = self._filter.max_m
            is_sane = 0.0 < sign.range_m <= max_m and 0.0 < sign.var_m2 <= max_m * max_m
            if is_sane:
                found.setdefault(sign.reference, []).append(sign)
            else:
                self.counts["ranges refused: beyond reason"] += 1
        return {reference: self._mean(some) for reference, some in found.items()}

    def _mean(self, signs: Sequence[SignRange]) -> tuple[float, float]:
        range_m = sum(one.range_m for one in signs) / len(signs)
        var_m2 = sum(one.var_m2 for one in signs) / len(signs)
        return range_m, var_m2 + (self._filter.sd_fraction * range_m) ** 2

    def _step(
        self,
        current: _Open,
        evidence: FrameEvidence,
        confirmed: Confirmed,
        signs: Mapping[Reference, tuple[float, float]],
        past: PastCues,
        moved: _Moved,
    ) -> Step:
        ranges = self._measured(current, signs, evidence.posteriors, moved.way_m)
        best, reference = _best(current, Reference(self._fusion.reference))
        more = past(best, reference)
        counts = {**evidence.counts, **more}
        if more:
            usable = self._without_static(more, moved, evidence.weights)
            also = self._confirmed(usable, evidence)
            confirmed = Confirmed(
                {**confirmed.counts, **also.counts}, {**confirmed.silent, **also.silent}
            )
        is_near = best is not None and best.mean_m <= self._fusion.dissent_within_m
        is_fresh = current.since_dissent_m >= self._fusion.dissent_every_m
        may_dissent = is_near and is_fresh and not moved.is_standing
        if may_dissent:
            current.since_dissent_m = 0.0
        ranged = {**signs, **{o.reference: (o.range_m, o.var_m2) for o in evidence.posteriors}}
        taken = {row.reference for row in ranges if row.measured_m is not None}
        ranged = {reference: one for reference, one in ranged.items() if reference in taken}
        situation = replace(
            self._situation(evidence, confirmed.counts, moved, self._to_start(ranged)),
            is_established=current.belief.is_established,
            is_near=is_near,
            may_dissent=may_dissent,
            range_m=None if best is None else best.mean_m,
        )
        self._believe(current, situation)
        silent = confirmed.silent
        if isinstance(current.model, PersistentMessageModel):
            silent = {**silent, **current.model.silent}
        self._count_silent(silent)
        belief = current.belief
        if belief.is_established and not situation.is_established:
            self.counts["approaches established"] += 1
        now = probabilities(belief, self._graph)
        return Step(
            evidence.t_ns, current.number, counts, ranges, now, belief.is_established, silent
        )

    def _believe(self, current: _Open, situation: Situation) -> None:
        """Update the belief; what waited for an intersection counts in its first frame, too."""
        model = current.model
        withdrawn = None if self._over_drive is None else self._fusion.withdrawn
        belief = multiply(current.belief, model(situation))
        belief = establish(belief, self._graph, self._fusion.established, withdrawn)
        current.belief = belief
        is_first = belief.is_established and not situation.is_established
        if is_first and isinstance(model, PersistentMessageModel):
            waiting = {cue: situation.counts[cue] for cue in model.silent}
            again = replace(situation, counts=waiting, is_established=True)
            self._believe(current, replace(again, moved_m=0.0, passed_s=0.0))

    def _situation(
        self,
        evidence: FrameEvidence,
        counts: Mapping[str, int],
        moved: _Moved,
        ranges: tuple[tuple[float, float], ...] = (),
    ) -> Situation:
        """Situation of a frame outside approaches."""
        return Situation(
            counts,
            is_established=False,
            objects=evidence.objects,
            is_new_picture=evidence.is_new_picture,
            moved_m=moved.way_m,
            passed_s=moved.time_s,
            advanced_m=moved.advanced_m,
            advanced_var_m2=moved.advanced_var_m2,
            ranges=ranges,
            is_standing=moved.is_standing,
            weights=evidence.weights,
        )

    def _to_start(
        self, ranged: Mapping[Reference, tuple[float, float]]
    ) -> tuple[tuple[float, float], ...]:
        """Measured ranges to the start; correlated successive ranges have more variance."""
        if self._over_drive is None or not ranged:
            return ()
        since_m, self._since_range_m = self._since_range_m, 0.0
        return ranges_to_start(ranged, since_m, self._filter.fade_m, self._fusion.length_m)

    def _measured(
        self,
        current: _Open,
        signs: Mapping[Reference, tuple[float, float]],
        posteriors: Sequence[RangePosterior],
        way_m: float,
    ) -> tuple[RangeRow, ...]:
        """Update with the signs and follow the posteriors; return the rows to write."""
        start_m = end_m = None
        if Reference.START in signs:
            current.start, start_m = self._weigh(current.start, *signs[Reference.START])
        if Reference.END in signs:
            current.end, end_m = self._weigh(current.end, *signs[Reference.END])
        for one in posteriors:
            if one.reference is Reference.START:
                current.start, start_m = self._follow(current.start, one, way_m), one.measured_m
            else:
                current.end, end_m = self._follow(current.end, one, way_m), one.measured_m
        rows = (
            (Reference.START, current.start.belief, start_m),
            (Reference.END, current.end.belief, end_m),
        )
        return tuple(
            RangeRow(reference, belief.mean_m, belief.var_m2, measured_m)
            for reference, belief, measured_m in rows
            if belief is not None
        )

    def _follow(self, track: RangeTrack, one: RangePosterior, way_m: float) -> RangeTrack:
        way_m = max(way_m, track.unseen_m)
        track, verdict = follow(track, one.range_m, one.var_m2, way_m, self._filter)
        self.counts["ranges restarted"] += verdict is Verdict.RESTARTED
        return track

    def _weigh(
        self, track: RangeTrack, range_m: float, var_m2: float
    ) -> tuple[RangeTrack, float | None]:
        near_m = self._fusion.dissent_within_m
        track, verdict = fuse_range(track, range_m, var_m2, self._filter, near_m)
        if verdict is Verdict.WAITS:
            self.counts["ranges waiting for a second observation"] += 1
            return track, None
        if verdict is Verdict.REFUSED:
            self.counts["ranges refused: outside the gate"] += 1
            return track, None
        if verdict is Verdict.RESTARTED:
            self.counts["ranges restarted"] += 1
        return track, range_m


def _has_way(evidence: FrameEvidence) -> bool:
    way_m, var_m2 = evidence.travelled_m, evidence.travelled_var_m2
    return way_m is not None and math.isfinite(way_m) and 0.0 <= var_m2 < math.inf


def _end_m(current: _Open, length_m: float) -> float | None:
    """Distance to the intersection's end; None where unknown."""
    if current.end.belief is not None:
        return current.end.belief.mean_m
    start = current.start.belief
    return None if start is None else start.mean_m + length_m


def _is_about_another(
    current: _Open, signs: Mapping[Reference, tuple[float, float]], longest_m: float
) -> bool:
    """Whether the first range shows that the approach opened too far away."""
    is_ranged = current.start.belief is not None or current.end.belief is not None
    if is_ranged or not signs or current.way_m == 0.0:
        return False
    nearest_m = min(range_m for range_m, _ in signs.values())
    return current.way_m + nearest_m > longest_m


def _best(current: _Open, wanted: Reference) -> tuple[RangeBelief | None, Reference | None]:
    """Range to the preferred reference, otherwise to the other one, unchanged."""
    known = {Reference.START: current.start.belief, Reference.END: current.end.belief}
    other = Reference.END if wanted is Reference.START else Reference.START
    for reference in (wanted, other):
        if known[reference] is not None:
            return known[reference], reference
    return None, None


def _over_drive(graph: FactorGraph, fusion: Fusion) -> TemporalFilter | None:
    """Build the filter that continues across approaches; None for kinds without one.

    Raises:
        ValueError: The kind has no fitted parameters; a vehicle file cannot have this state.
    """
    if fusion.kind not in ("temporal", "combined"):
        return None
    if fusion.temporal is None or (fusion.kind == "combined" and fusion.combined is None):
        raise ValueError("fusion.temporal: expected what crosscue fit temporal wrote, got None")
    model = temporal_model(graph, fusion.temporal)
    if fusion.kind == "combined" and fusion.combined is not None:
        return CombinedFilter(model, CombinedModel(graph, fusion.combined))
    return TemporalFilter(model)


def message_models_of(graph: FactorGraph, fusion: Fusion) -> Callable[[], MessageModel]:
    """Return a factory of the message model of each approach.

    Raises:
        ValueError: ``calibrated`` has no fitted parameters; a vehicle file cannot have this state.
    """
    if fusion.kind == "persistent":
        return lambda: PersistentMessageModel(graph, fusion.dissent)
    if fusion.kind in ("source", "temporal", "combined", None):
        model = published_message_model(graph, fusion.dissent)
        return lambda: model
    if fusion.calibrated is None:
        raise ValueError("fusion.calibrated: expected what crosscue fit messages wrote, got None")
    cues, size = cue_messages_of(graph, fusion.calibrated), len(graph.features)
    return lambda: CalibratedMessageModel(size, cues)
