"""The scene part of the estimate stage: cues, ranges and beliefs from stored frames.

All inputs are the run's own tables (frames, detections, road, measurements), so no picture is
opened and no log is read. Settings of cues, ranges and belief can therefore be tried in seconds,
and each cue can be left out to measure its contribution.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

from crosscue.detectors.base import is_repeated
from crosscue.detectors.cues.frame import CuePass
from crosscue.detectors.cues.observed import FrameDetections, Place
from crosscue.detectors.cues.same_object import label_meanings
from crosscue.detectors.ranging.object_tracks import CarStep
from crosscue.eval.pipeline.progress import report_time
from crosscue.eval.pipeline.scene.looked_for import needing_masks, not_looked_for
from crosscue.eval.pipeline.scene.motion_ranges import MotionRanges, RangedObject
from crosscue.eval.pipeline.scene.sign_ranges import MEASURED, SignRanges
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.manifest import DetectManifest
from crosscue.eval.runs.tables.stored_frames import stored_frames
from crosscue.eval.runs.tables.travelled import Odometer, odometer_of
from crosscue.fusion.approaches import Approaches, RangeRow, Step
from crosscue.fusion.belief import begin, probabilities
from crosscue.fusion.evidence import FrameEvidence, PastCues
from crosscue.fusion.factor_graph import graph_of
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.time.segments import ONE_SEGMENT, Timeline
from crosscue.replay.vehicle.vehicle import Vehicle

from .outcome import ApproachSummary, SceneOutcome
from .roads import Roads, pitches_of

if TYPE_CHECKING:
    import pyarrow as pa

ROWS_HELD: Final = 8192
# Min fraction of the time between two frames that odometry must cover to measure the distance.
COVERED: Final = 0.9
# Cues of roads, whose openings also give ranges.
ROADS: Final = frozenset(("road_left", "road_straight", "road_right"))
# Feature columns of ``belief.parquet``, unless the vehicle file's graph has others.
FEATURES: Final = ("intersection", "left", "right", "straight")

# Callback for a batch of a table: its name and columns.
Sink = Callable[[str, dict[str, list[Any]]], None]


def nothing_past(_t_ns: int) -> PastCues | None:
    """Return None, because without a Mobileye no cue beyond the intersection is evaluated."""
    return None


def estimate_scene(
    run: RunFolder,
    vehicle: Vehicle,
    detected: DetectManifest,
    sink: Sink,
    past: Callable[[int], PastCues | None] = nothing_past,
    without: frozenset[str] = frozenset(),
    timeline: Timeline = ONE_SEGMENT,
    on_restart: Callable[[int], None] = lambda _: None,
) -> SceneOutcome:
    """Run cues, range filter and belief over a run's stored frames.

    Args:
        run: A run with the tables of the detect stage and ``measurements.parquet``.
        vehicle: Settings.
        detected: Manifest of the detect stage.
        sink: Called with the rows of ``cues``, ``range`` and ``belief``.
        past: Function from a time to the Mobileye's cues beyond the intersection.
        without: Cues to leave out, together with their ranges, as if they had not been evaluated.
        timeline: Time segments of the drive; after a long gap everything starts over.
        on_restart: Called with the drive time of each new start.

    Raises:
        RunError: A table is missing or damaged.
        VehicleError: A cue or feature of the settings does not exist.
    """
    graph = graph_of(vehicle.fusion)
    scene = _Scene(
        vehicle,
        Approaches(graph, vehicle.fusion, vehicle.range_filter),
        EgoMotion(odometer_of(run)),
        _Rows(sink, features_of(vehicle), gives_reasons(vehicle)),
        Roads(vehicle, pitches_of(run)) if vehicle.regions.kind == "area" else None,
    )
    boxes_only = needing_masks(detected.detectors, vehicle.cars.labels)
    restarts = Restarts(vehicle, timeline)
    regions = vehicle.regions
    fresh_regions = regions.kind != "picture" or detected.settings.regions != regions
    meanings = label_meanings(vehicle)
    frames = stored_frames(
        run,
        detected.detectors,
        with_road_masks=fresh_regions,
        meanings=None if meanings == label_meanings(detected.settings) else meanings,
    )
    for frame in frames:
        vehicle.camera.check_size(frame.size_px)
        fresh_ns = restarts.before(frame.t_ns)
        if fresh_ns is not None:
            scene.restart(fresh_ns)
            on_restart(fresh_ns)
        scene.step(frame, past(frame.t_ns), without | boxes_only)
        report_time("estimating beliefs", timeline, frame.t_ns)
    scene.rows.flush()
    scene.approaches.finish()
    return SceneOutcome(
        scene.frames,
        dict(sorted(scene.positive.items())),
        tuple(scene.summaries.values()),
        scene.approaches.counts
        + scene.motion.counts
        + scene.cues.controls.counts
        + scene.cues.notes(),
        scene.ego.without_odometry,
        {cue: one for cue, one in scene.cues.candidates.items() if cue not in boxes_only},
        scene.signs.by_cue,
        not_looked_for(
            scene.looked,
            detected.detectors,
            vehicle.cue_labels(),
            scene.cues.not_followed,
            boxes_only,
        ),
    )


@dataclass(slots=True)
class Restarts:
    """Detection of long gaps between frames."""

    vehicle: Vehicle
    timeline: Timeline
    _number: int = 0

    def before(self, t_ns: int) -> int | None:
        """Return the new segment's start if a frame at ``t_ns`` is the first after a long gap."""
        segments, found = self.timeline.segments, None
        limit_ns = round(self.vehicle.time.restart_after_s * 1e9)
        while self._number + 1 < len(segments):
            following = segments[self._number + 1]
            if following.begins_ns > t_ns:
                break
            self._number += 1
            if following.gap_ns is None or following.gap_ns > limit_ns:
                found = following.begins_ns
        return found


@dataclass(slots=True)
class EgoMotion:
    """Motion of the ego vehicle between frames.

    Attributes:
        odometer: Odometry of the run.
        without_odometry: Number of frames whose distance from the previous frame was not measured.
        is_known: True once a distance was measured.
    """

    odometer: Odometer
    without_odometry: int = 0
    is_known: bool = False
    _last_ns: int | None = None

    def __call__(self, t_ns: int) -> tuple[FrameEvidence, CarStep]:
        """Return the motion since the previous frame, as evidence and in the trackers' form."""
        way = self.odometer.until(t_ns)
        gap_ns = 0 if self._last_ns is None else t_ns - self._last_ns
        is_covered = way.covered_ns >= COVERED * gap_ns
        self.without_odometry += way.covered_ns - way.assumed_ns < COVERED * gap_ns
        self.is_known |= is_covered and gap_ns > 0
        self._last_ns = t_ns if self._last_ns is None else max(t_ns, self._last_ns)
        travelled_m = way.distance_m if is_covered else None
        turned_rad = way.turn_rad if is_covered else None
        evidence = FrameEvidence(
            t_ns=t_ns,
            travelled_m=travelled_m,
            travelled_var_m2=way.var_m2,
            signs=(),
            counts={},
            turned_rad=turned_rad,
            assumed_m=way.assumed_m,
        )
        return evidence, CarStep(travelled_m, way.var_m2, turned_rad or 0.0, max(gap_ns, 0) * 1e-9)

    def restart(self, t_ns: int) -> None:
        """Ignore the odometry before ``t_ns``."""
        self.odometer.skip_to(t_ns)
        self._last_ns = None


@dataclass(slots=True)
class _Scene:
    vehicle: Vehicle
    approaches: Approaches
    ego: EgoMotion
    rows: _Rows
    roads: Roads | None = None
    cues: CuePass = field(init=False)
    signs: SignRanges = field(init=False)
    motion: MotionRanges = field(init=False)
    priors: Mapping[str, float] = field(init=False)
    frames: int = 0
    positive: Counter[str] = field(default_factory=Counter)
    looked: set[str] = field(default_factory=set)
    summaries: dict[int, ApproachSummary] = field(default_factory=dict)
    _before: FrameDetections | None = None
    _ranges: tuple[RangeRow, ...] = ()

    def __post_init__(self) -> None:
        self.signs = SignRanges(self.vehicle)
        self.cues = CuePass(self.vehicle)
        self.motion = MotionRanges(self.vehicle)
        graph = graph_of(self.vehicle.fusion)
        self.priors = probabilities(begin(graph), graph)

    def step(self, frame: FrameDetections, past: PastCues | None, without: frozenset[str]) -> None:
        seen = frame
        evidence, ego = self.ego(seen.t_ns)
        if self.roads is not None:
            seen = replace(seen, road=self.roads(seen, evidence))
        found = self.cues(seen, ego, self._place(ego))
        counts = {cue: count for cue, count in found.counts.items() if cue not in without}
        signs = tuple(
            sign for sign in self.signs(found.objects) if _MEASURES[sign.reference] not in without
        )
        evidence = replace(evidence, counts=counts, signs=signs)
        posteriors = self.motion(self.cues.controls.tracks, ego, without)
        if not self.ego.is_known:
            # From an assumed size alone, without any motion, a range would be a guess.
            posteriors = ()
        if self.roads is not None and not without >= ROADS:
            if not posteriors:
                posteriors = self.roads.ranges()
            elif not self.roads.fits(posteriors):
                # A side street before the intersection that is ranged.
                counts = {cue: count for cue, count in counts.items() if cue not in ROADS}
                evidence = replace(evidence, counts=counts)
        evidence = replace(evidence, posteriors=posteriors, is_new_picture=self._is_new(seen))
        self.rows.add_objects(seen.t_ns, self.motion.objects)
        step = (
            self.approaches(evidence)
            if past is None
            else self.approaches(evidence, _without(past, without))
        )
        self.frames += 1
        self.looked.update(step.counts)
        self.positive.update(cue for cue, count in step.counts.items() if count)
        self._ranges = step.ranges
        self.rows.add(step)
        self._sum_up(step)

    def _place(self, ego: CarStep) -> Place | None:
        """Return the intersection's place in this frame, predicted from the previous frame."""
        if ego.way_m is None:
            return None
        return intersection_place(self._ranges, ego.way_m, self.vehicle.fusion.length_m)

    def _is_new(self, seen: FrameDetections) -> bool:
        """Return False for a repeated picture, recognized by bit-identical detections.

        Only beliefs that depend on successive frames need this.
        """
        if self.vehicle.fusion.kind not in ("persistent", "temporal", "combined"):
            return True
        before, self._before = self._before, seen
        return before is None or not is_repeated(before.boxes, seen.boxes)

    def restart(self, t_ns: int) -> None:
        """Know nothing of what was before ``t_ns``."""
        self.approaches.restart()
        self.ego.restart(t_ns)
        self.cues.restart()
        self.motion.restart()
        if self.roads is not None:
            self.roads.restart()
        self._before = None
        self._ranges = ()

    def _sum_up(self, step: Step) -> None:
        if step.approach is None:
            return
        is_new = step.approach not in self.summaries
        one = self.summaries.setdefault(
            step.approach, ApproachSummary(step.approach, step.t_ns, step.t_ns)
        )
        one.end_ns = step.t_ns
        one.probabilities = step.probabilities
        one.not_seen = tuple(
            name
            for name, p in step.probabilities.items()
            if p == self.priors[name] and (is_new or name in one.not_seen)
        )
        is_sure = step.probabilities.get(FEATURES[0], 0.0) > self.vehicle.fusion.established
        if is_sure and step.ranges and one.detected_ns is None:
            one.detected_ns = step.t_ns
            one.detected_m = step.ranges[0].range_m
            one.reference = str(step.ranges[0].reference)


def intersection_place(ranges: Sequence[RangeRow], way_m: float, length_m: float) -> Place | None:
    """Return an intersection's place after ``way_m`` of travel; None without any range.

    Args:
        ranges: At most one range for each reference.
        way_m: Distance travelled since the time of the ranges.
        length_m: Length of the intersection, used if only one reference is known.
    """
    if not ranges:
        return None
    known = {one.reference: one.range_m - way_m for one in ranges}
    start_m = known.get(Reference.START)
    end_m = known.get(Reference.END)
    if start_m is None:
        assert end_m is not None
        start_m = end_m - length_m
    if end_m is None:
        end_m = start_m + length_m
    return Place(start_m, end_m, max(one.var_m2 for one in ranges) ** 0.5)


_MEASURES: Final = {reference: cue.name for cue, reference in MEASURED}


def _without(past: PastCues, without: frozenset[str]) -> PastCues:
    if not without:
        return past
    return lambda belief, reference: {
        cue: count for cue, count in past(belief, reference).items() if cue not in without
    }


@dataclass(slots=True)
class _Rows:
    """Rows of the tables, passed to the sink in batches of some thousand."""

    sink: Sink
    features: Sequence[str]
    gives_reasons: bool
    cues: list[tuple[Any, ...]] = field(default_factory=list)
    ranges: list[tuple[Any, ...]] = field(default_factory=list)
    beliefs: list[tuple[Any, ...]] = field(default_factory=list)
    objects: list[tuple[Any, ...]] = field(default_factory=list)

    def add_objects(self, t_ns: int, objects: Sequence[RangedObject]) -> None:
        self.objects += [
            (
                t_ns,
                one.cue,
                one.object,
                str(one.facing),
                None if one.reference is None else str(one.reference),
                one.range_m,
                one.var_m2,
                one.height_m,
                *one.box_px,
            )
            for one in objects
        ]

    def add(self, step: Step) -> None:
        t_ns, number = step.t_ns, step.approach
        self.cues += [(t_ns, number, cue, count) for cue, count in step.counts.items()]
        self.ranges += [
            (t_ns, number, str(row.reference), row.range_m, row.var_m2, row.measured_m)
            for row in step.ranges
        ]
        if number is not None:
            values = (step.probabilities[feature] for feature in self.features)
            row: tuple[Any, ...] = (t_ns, number, *values, step.established)
            if self.gives_reasons:
                row = (*row, "; ".join(f"{cue}: {why}" for cue, why in step.not_believed.items()))
            self.beliefs.append(row)
        if len(self.cues) > ROWS_HELD:
            self.flush()

    def flush(self) -> None:
        for name, rows, columns in (
            ("cues", self.cues, CUE_COLUMNS),
            ("range", self.ranges, RANGE_COLUMNS),
            ("belief", self.beliefs, self._belief_columns()),
            ("ranged_objects", self.objects, OBJECT_COLUMNS),
        ):
            if rows:
                parts = zip(*rows, strict=True)
                self.sink(name, dict(zip(columns, map(list, parts), strict=True)))
                rows.clear()

    def _belief_columns(self) -> tuple[str, ...]:
        reasons = ("not_believed",) if self.gives_reasons else ()
        return ("t_ns", "approach", *self.features, "established", *reasons)


CUE_COLUMNS: Final = ("t_ns", "approach", "cue", "count")
OBJECT_COLUMNS: Final = (
    "t_ns",
    "cue",
    "object",
    "facing",
    "reference",
    "range_m",
    "var_m2",
    "height_m",
    "x0",
    "y0",
    "x1",
    "y1",
)
RANGE_COLUMNS: Final = ("t_ns", "approach", "reference", "range_m", "var_m2", "measured_m")


def features_of(vehicle: Vehicle) -> tuple[str, ...]:
    """Return the names of the features of the belief, including user-defined ones."""
    return tuple(feature.name for feature in graph_of(vehicle.fusion).features)


def gives_reasons(vehicle: Vehicle) -> bool:
    """Return whether ``belief.parquet`` has reasons for cues that were observed but not used."""
    return vehicle.fusion.kind == "persistent"


def scene_schemas(
    features: Sequence[str] = FEATURES, *, gives_reasons: bool = False
) -> dict[str, pa.Schema]:
    """Return the schemas of the tables that this stage writes."""
    import pyarrow as pa

    number, integer, text = pa.float64(), pa.int64(), pa.string()
    reasons = [("not_believed", text)] if gives_reasons else []
    return {
        "cues": pa.schema(
            [("t_ns", integer), ("approach", integer), ("cue", text), ("count", integer)]
        ),
        "range": pa.schema(
            [
                ("t_ns", integer),
                ("approach", integer),
                ("reference", text),
                ("range_m", number),
                ("var_m2", number),
                ("measured_m", number),
            ]
        ),
        "belief": pa.schema(
            [
                ("t_ns", integer),
                ("approach", integer),
                *((name, number) for name in features),
                ("established", pa.bool_()),
                *reasons,
            ]
        ),
        "ranged_objects": pa.schema(
            [
                ("t_ns", integer),
                ("cue", text),
                ("object", integer),
                ("facing", text),
                ("reference", text),
                ("range_m", number),
                ("var_m2", number),
                ("height_m", number),
                *((name, number) for name in ("x0", "y0", "x1", "y1")),
            ]
        ),
    }
