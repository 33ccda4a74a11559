"""The scene part of the estimate stage: cues, ranges and beliefs from stored frames.

All inputs are the run's own tables (frames, detections, road, measurements), so no picture is
opened and no log is read. Settings of cues, ranges and belief can therefore be tried in seconds,
and each cue can be left out to measure its contribution.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple

from crosscue.detectors.base import is_repeated
from crosscue.detectors.cues.frame import CuePass
from crosscue.detectors.cues.observed import FrameCues, FrameDetections, Place
from crosscue.detectors.ranging.object_tracks import CarStep
from crosscue.eval.pipeline.progress import report_time
from crosscue.eval.pipeline.scene.looked_for import needing_masks, not_looked_for
from crosscue.eval.pipeline.scene.motion_ranges import MotionRanges, RangedObject
from crosscue.eval.pipeline.scene.sign_ranges import MEASURED, SignRanges
from crosscue.eval.runs.candidates import candidate_rows
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.manifest import ApproachRow, DetectManifest, SceneSummary
from crosscue.eval.runs.tables.columns import OF_RUN, PROBABILITY, Columns
from crosscue.eval.runs.tables.labelled import LabelledSink
from crosscue.eval.runs.tables.mobileye_tables import StoredMobileye
from crosscue.eval.runs.tables.parquet import TableFolder
from crosscue.eval.runs.tables.stored_frames import stored_frames
from crosscue.eval.runs.tables.travelled import Odometer, odometer_of
from crosscue.fusion.approaches import Approaches, RangeRow, Step
from crosscue.fusion.belief import begin, probabilities
from crosscue.fusion.evidence import FrameEvidence, PastCues
from crosscue.fusion.factor_graph import graph_of
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.time.segments import Timeline
from crosscue.replay.vehicle.vehicle import Vehicle

from .map_cue import map_ahead
from .roads import Roads, pitches_of

ROWS_HELD: Final = 8192
# Min fraction of the time between two frames that odometry must cover to measure the distance.
COVERED: Final = 0.9
# Cues of roads, whose openings also give ranges.
ROADS: Final = frozenset(("road_left", "road_straight", "road_right"))
# Feature columns of ``belief.parquet``, unless the vehicle file's graph has others.
FEATURES: Final = ("intersection", "left", "right", "straight")

# Callback for a batch of a table: its name and columns.
Sink = Callable[[str, dict[str, list[Any]]], None]


class SceneStep(NamedTuple):
    """One frame with the ego vehicle's motion, in order of time.

    Attributes:
        frame: Stored detections.
        ego: Motion of the ego vehicle since the previous frame.
        evidence: The same motion, as evidence.
        place: Where the intersection is now, by the ranges of the previous frame.
    """

    frame: FrameDetections
    ego: CarStep
    evidence: FrameEvidence
    place: Place | None


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


class Scene:
    """What the car sees, frame by frame: cues, ranges and belief from a run's stored frames."""

    def __init__(
        self,
        drive: Drive,
        run: RunFolder,
        detected: DetectManifest,
        without: frozenset[str] = frozenset(),
    ) -> None:
        """Open the stored frames.

        Args:
            drive: Vehicle file and time segments; after a long gap everything starts over.
            run: A run with the tables of the detect stage and ``measurements.parquet``.
            detected: Manifest of the detect stage.
            without: Cues to leave out, together with their ranges, as if they had not been
                evaluated.

        Raises:
            RunError: A table is missing or damaged.
            VehicleError: A cue or feature of the settings does not exist.
        """
        vehicle = drive.vehicle
        self._drive, self._run, self._detected = drive, run, detected
        graph = graph_of(vehicle.fusion)
        self._priors = probabilities(begin(graph), graph)
        self._approaches = Approaches(graph, vehicle.fusion, vehicle.range_filter)
        self._ego = EgoMotion(odometer_of(run))
        self._is_area = vehicle.regions.kind == "area"
        self._roads = Roads(vehicle, pitches_of(run)) if self._is_area else None
        self._past = StoredMobileye(run, vehicle.past)
        self._map = map_ahead(run, vehicle)
        self._cues = CuePass(vehicle)
        self._signs = SignRanges(vehicle)
        self._motion = MotionRanges(vehicle)
        self._boxes_only = needing_masks(detected.detectors, vehicle.cars.labels)
        self._without = without | self._boxes_only
        self._frames = 0
        self._positive: Counter[str] = Counter()
        self._looked: set[str] = set()
        self._approach_rows: dict[int, ApproachRow] = {}
        self._before: FrameDetections | None = None
        self._ranges: tuple[RangeRow, ...] = ()

    def steps(self) -> Iterator[SceneStep]:
        """Yield the frames in order of time, each with the motion since the one before."""
        vehicle, timeline = self._drive.vehicle, self._drive.segments
        restarts = Restarts(vehicle, timeline)
        stored, regions = self._detected.settings, vehicle.regions
        frames = stored_frames(
            self._run,
            self._detected,
            vehicle,
            with_road_masks=regions.kind != "picture" or stored.regions != regions,
        )
        for frame in frames:
            vehicle.camera.check_size(frame.size_px)
            fresh_ns = restarts.before(frame.t_ns)
            if fresh_ns is not None:
                self._restart(fresh_ns)
            evidence, ego = self._ego(frame.t_ns)
            if self._roads is not None:
                frame = replace(frame, road=self._roads(frame, evidence))
            yield SceneStep(frame, ego, evidence, self._place(ego))
            report_time("estimating beliefs", timeline, frame.t_ns)
        self._approaches.finish()

    def observe(self, step: SceneStep) -> FrameCues:
        """Return the cues of a frame."""
        found = self._cues(step.frame, step.ego, step.place)
        on_map = self._map(step.frame.t_ns)
        counts = {
            cue: count
            for cue, count in {**found.counts, **on_map}.items()
            if cue not in self._without
        }
        return replace(found, counts=counts)

    def range(self, step: SceneStep, cues: FrameCues) -> FrameEvidence:
        """Return the evidence of a frame: its motion, its cues, and ranges to the intersection."""
        without, counts, evidence = self._without, cues.counts, step.evidence
        signs = tuple(
            sign for sign in self._signs(cues.objects) if _MEASURES[sign.reference] not in without
        )
        posteriors = self._motion(self._cues.controls.tracks, step.ego, without)
        if not self._ego.is_known:
            # From an assumed size alone, without any motion, a range would be a guess.
            posteriors = ()
        if self._roads is not None and not without >= ROADS:
            evidence = self._roads.with_shape(evidence)
            if not posteriors:
                posteriors = self._roads.ranges()
            elif not self._roads.fits(posteriors):
                # A side street before the intersection that is ranged.
                counts = {cue: count for cue, count in counts.items() if cue not in ROADS}
        return replace(
            evidence,
            counts=counts,
            signs=signs,
            posteriors=posteriors,
            is_new_picture=self._is_new(step.frame),
        )

    @property
    def objects(self) -> Sequence[RangedObject]:
        """Objects that the newest frame ranges."""
        return self._motion.objects

    def believe(self, evidence: FrameEvidence) -> Step:
        """Return ranges and belief after a frame."""
        past = _without(self._past.cues(evidence.t_ns), self._without)
        step = self._approaches(evidence, past)
        if self._roads is not None:
            self._roads.believe(step.established)
        self._frames += 1
        self._looked.update(step.counts)
        self._positive.update(cue for cue, count in step.counts.items() if count)
        self._ranges = step.ranges
        self._sum_up(step)
        return step

    def outcome(self) -> SceneSummary:
        """Return what the frames have shown."""
        cues, candidates = self._cues, self._cues.candidates
        counts = self._approaches.counts + self._motion.counts + cues.controls.counts
        if self._roads is not None:
            counts += self._roads.notes()
        return SceneSummary(
            frames=self._frames,
            positive=dict(sorted(self._positive.items())),
            counts=dict(counts + cues.notes()),
            without_odometry=self._ego.without_odometry,
            approaches=tuple(self._approach_rows.values()),
            candidates=candidate_rows(
                {cue: one for cue, one in candidates.items() if cue not in self._boxes_only}
            ),
            ranged=candidate_rows(self._signs.by_cue),
            not_looked_for=not_looked_for(
                self._looked,
                self._detected.detectors,
                self._drive.vehicle.cue_labels(),
                cues.not_followed,
                self._boxes_only,
            ),
        )

    def _place(self, ego: CarStep) -> Place | None:
        """Return the intersection's place in this frame, predicted from the previous frame."""
        if ego.way_m is None:
            return None
        return intersection_place(self._ranges, ego.way_m, self._drive.vehicle.fusion.length_m)

    def _is_new(self, frame: FrameDetections) -> bool:
        """Return False for a repeated picture, recognized by bit-identical detections.

        Only beliefs that depend on successive frames need this.
        """
        if self._drive.vehicle.fusion.kind not in ("persistent", "temporal", "combined"):
            return True
        before, self._before = self._before, frame
        return before is None or not is_repeated(before.boxes, frame.boxes)

    def _restart(self, t_ns: int) -> None:
        self._approaches.restart()
        self._ego.restart(t_ns)
        self._cues.restart()
        self._motion.restart()
        if self._roads is not None:
            self._roads.restart()
        self._past.forget_before(t_ns)
        self._before = None
        self._ranges = ()

    def _sum_up(self, step: Step) -> None:
        if step.approach is None:
            return
        known = self._approach_rows.get(step.approach)
        one = known or ApproachRow(
            number=step.approach,
            start_ns=step.t_ns,
            end_ns=step.t_ns,
            detected_ns=None,
            detected_m=None,
            reference=None,
            probabilities={},
        )
        changed: dict[str, object] = {
            "end_ns": step.t_ns,
            "probabilities": dict(step.probabilities),
            "not_seen": tuple(
                name
                for name, p in step.probabilities.items()
                if p == self._priors[name] and (known is None or name in known.not_seen)
            ),
        }
        is_sure = step.probabilities.get(FEATURES[0], 0.0) > self._drive.vehicle.fusion.established
        if is_sure and step.ranges and one.detected_ns is None:
            first = step.ranges[0]
            changed |= {
                "detected_ns": step.t_ns,
                "detected_m": first.range_m,
                "reference": str(first.reference),
            }
        self._approach_rows[step.approach] = one.model_copy(update=changed)


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
class SceneTables:
    """Rows of the tables of the scene, passed to a sink in batches of some thousand."""

    sink: Sink
    features: Sequence[str]
    gives_reasons: bool
    cues: list[tuple[Any, ...]] = field(default_factory=list)
    ranges: list[tuple[Any, ...]] = field(default_factory=list)
    beliefs: list[tuple[Any, ...]] = field(default_factory=list)
    objects: list[tuple[Any, ...]] = field(default_factory=list)

    def add(self, step: Step, objects: Sequence[RangedObject]) -> None:
        """Add the rows of a frame: its step, and the objects that were ranged."""
        t_ns, number = step.t_ns, step.approach
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
        """Pass on all rows."""
        columns = scene_columns(self.features, gives_reasons=self.gives_reasons)
        of_table = (self.cues, self.ranges, self.beliefs, self.objects)
        for (name, names), rows in zip(columns.items(), of_table, strict=True):
            if rows:
                parts = zip(*rows, strict=True)
                self.sink(name, dict(zip(names, map(list, parts), strict=True)))
                rows.clear()


@contextmanager
def tables_of_scene(
    drive: Drive, run: TableFolder, detected: DetectManifest
) -> Iterator[SceneTables]:
    """Yield the tables of the scene in a run folder."""
    vehicle, timeline = drive.vehicle, drive.segments
    clock = timeline.clock(detected.camera_log)
    features, reasons = features_of(vehicle), gives_reasons(vehicle)
    with ExitStack() as stack:
        sinks = {
            name: stack.enter_context(LabelledSink(run, name, timeline, clock, columns))
            for name, columns in scene_columns(features, gives_reasons=reasons).items()
        }
        tables = SceneTables(lambda name, rows: sinks[name].write(rows), features, reasons)
        yield tables
        tables.flush()


def features_of(vehicle: Vehicle) -> tuple[str, ...]:
    """Return the names of the features of the belief, including user-defined ones."""
    return tuple(feature.name for feature in graph_of(vehicle.fusion).features)


def gives_reasons(vehicle: Vehicle) -> bool:
    """Return whether ``belief.parquet`` has reasons for cues that were observed but not used."""
    return vehicle.fusion.kind == "persistent"


def scene_columns(
    features: Sequence[str] = FEATURES, *, gives_reasons: bool = False
) -> dict[str, Columns]:
    """Return the columns of the tables of the scene, in the order of rows."""
    belief = OF_RUN["belief"]
    last = ("established", *(("not_believed",) if gives_reasons else ()))
    names = ("t_ns", "approach", *features, *last)
    found = {name: OF_RUN[name] for name in ("cues", "range", "belief", "ranged_objects")}
    return found | {"belief": {name: belief.get(name, PROBABILITY) for name in names}}
