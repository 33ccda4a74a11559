"""The detect stage: from a drive's camera to detections, road and cues in a run folder."""

from __future__ import annotations

import difflib
import time
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from crosscue.detectors.base import (
    MIN_SCORE,
    Detections,
    DetectorChoice,
    Found,
    RoadMask,
    calibrated_labels,
    is_calibrated,
    min_scores_of,
    reportable,
)
from crosscue.detectors.cues.frame import CuePass
from crosscue.detectors.cues.observed import (
    DetectorRole,
    FrameCues,
    all_labels,
    detector_role,
    seen,
)
from crosscue.detectors.cues.road import road_fractions
from crosscue.detectors.cues.same_object import KEPT, label_meanings, same_objects
from crosscue.detectors.overlay import Drawer
from crosscue.detectors.ranging.detection_range import detection_range
from crosscue.detectors.registry import is_plugin, knows_simulated_only, make
from crosscue.detectors.result_cache import ResultCache
from crosscue.detectors.runner import FrameCounts, FrameResult, Named, Runner
from crosscue.eval.pipeline.outcome import DetectOutcome
from crosscue.eval.runs.account import Account, account, detecting_of, reading_of
from crosscue.eval.runs.folder import (
    RunFolder,
    clear,
    locked,
    staged,
    write_manifest,
    write_timings,
)
from crosscue.eval.runs.logs import input_of, is_simulated, log_names, log_rows
from crosscue.eval.runs.manifest import (
    DetectCounts,
    DetectManifest,
    DetectorRow,
    DetectTimings,
    Timings,
    selection_record,
)
from crosscue.eval.runs.tables.labelled import LabelledSink
from crosscue.eval.runs.tables.skipped import write_skipped
from crosscue.replay.base import Log, Selection
from crosscue.replay.columns import Block, Int64s, Topic
from crosscue.replay.errors import EmptyResultError, VehicleError
from crosscue.replay.files.made_of import SIMULATED
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import unless_damaged
from crosscue.replay.progress import Progress, emit
from crosscue.replay.signals.extractor import SampleExtractor, probe_clocks
from crosscue.replay.signals.plan import chosen_camera, pictures_only
from crosscue.replay.time.segments import LogClock, TimedLog, Timeline, gaps_text, shift_of
from crosscue.replay.vehicle.vehicle import Vehicle
from crosscue.replay.versions import versions_and_commit

from .clocks import clock_rows
from .drive_time import camera_timeline, time_segments
from .empty_result import empty_result, nothing_left
from .visual import TABLE as VISUAL
from .visual import VisualPass, uses_pictures, visual_schema

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True, slots=True)
class Detecting:
    """Options of the detect stage.

    Attributes:
        choices: Detectors, in order.
        cache: File with results of earlier runs, or None.
        draw: Number of pictures to write with detections drawn.
        resume: Keep detections of an earlier start that would be the same.
        is_required: The user named the detectors, so a drive without a camera is an error.
    """

    choices: tuple[DetectorChoice, ...]
    cache: Path | None = None
    draw: int = 0
    resume: bool = False
    is_required: bool = False


def choices_of(vehicle: Vehicle) -> dict[str, DetectorChoice]:
    """Return the detectors that the vehicle file defines, by name."""
    return {
        name: DetectorChoice(
            name,
            section.kind,
            section.settings | ({} if section.card is None else {"card": section.card}),
        )
        for name, section in vehicle.detectors.items()
    }


def detect_drive(
    logs: Sequence[Log],
    vehicle: Vehicle,
    run: RunFolder,
    selection: Selection,
    choices: Sequence[DetectorChoice],
    cache: Path | None = None,
    draw: int = 0,
) -> DetectOutcome:
    """Run detectors over the only camera of a drive, into an empty run folder.

    The folder is locked meanwhile, and cleared first. See ``detect_into`` for the arguments.
    """
    with locked(run), staged(run) as new, nothing_left(new):
        clear(new, input_of(run, logs, vehicle, selection, choices, draw, None))
        detecting = Detecting(tuple(choices), cache, draw)
        outcome = detect_into(logs, vehicle, new, selection, detecting)
    return replace(outcome, run=run)


def detect_into(
    logs: Sequence[Log],
    vehicle: Vehicle,
    run: RunFolder,
    selection: Selection,
    detecting: Detecting,
    timeline: Timeline | None = None,
) -> DetectOutcome:
    """Run detectors over the only camera of a drive, into a locked run folder.

    Args:
        logs: All open logs of the drive.
        vehicle: Settings of the vehicle file.
        run: The run folder.
        selection: The part of the logs to use.
        detecting: Detectors, cache and pictures to write.
        timeline: The drive's time segments, if already known.

    Raises:
        VehicleError: The drive has several cameras, or a card, weights or settings are invalid.
        EmptyResultError: The drive has no camera, or the selected part contains no frame.
        OutputError: The disk is full.
    """
    began = time.monotonic()
    choices = detecting.choices
    camera = only_camera(logs, vehicle)
    named = [Named(choice.name, make(choice)) for choice in choices]
    uncounted = _uncounted(named, choices, vehicle)
    reading = _Reading(logs, camera, vehicle, selection, timeline)
    with ResultCache(detecting.cache) as results:
        runner = Runner(
            named,
            results,
            reading.topic.name,
            vehicle.camera.depth_bits,
            reading.spoil,
            vehicle.cues.traffic_light_labels,
            vehicle.cues.stop_sign_labels,
            is_one_size=vehicle.camera.focal_px is not None,
        )
        tables = _Tables(
            run,
            reading.topic.name,
            vehicle,
            named,
            Drawer(run.file("pictures"), detecting.draw),
            CuePass(vehicle),
            [choice.kind == "signs" for choice in choices],
            reading.timeline,
            reading.clock,
            notices=uncounted,
            visual=VisualPass(vehicle)
            if uses_pictures(logs, vehicle, finds_road=_finds_road(named))
            else None,
        )
        _run_detectors(reading, runner, tables)
        frames = runner.counts.frames
        if not frames:
            raise empty_result(_no_frames(reading.topic, reading.ledger), logs, selection)
        made = account(
            reading_of([reading.ledger]), detecting_of(reading.topic.name, reading.ledger, frames)
        )
        write_skipped(run, [reading.ledger], made.reading, timeline=reading.timeline)
        seconds = time.monotonic() - began
        write_timings(run, _timings(seconds, runner.counts))
        manifest = _manifest(reading, choices, runner.counts, tables, made)
        write_manifest(run, manifest)
    return DetectOutcome(
        run,
        reading.ledger,
        runner.counts,
        tables.objects,
        tables.cue_frames,
        manifest.notices,
        seconds,
        made,
        reading.timeline.has_gaps,
    )


def _finds_road(named: Sequence[Named]) -> bool:
    """Return whether a detector declares that it finds no objects, as those of road do."""
    return any(reportable(one.detector) == () for one in named)


def only_camera(logs: Sequence[Log], vehicle: Vehicle) -> tuple[int, Topic]:
    """Return the index of the camera's log, and its topic.

    Raises:
        VehicleError: The drive has several cameras.
        EmptyResultError: It has none.
        LogError: It has none, and a log is damaged.
    """
    camera = chosen_camera(
        [(i, topic) for i, log in enumerate(logs) for topic in log.topics], vehicle
    )
    with unless_damaged(logs, EmptyResultError):
        if camera is None:
            raise EmptyResultError(
                f"{logs[0].path}: no camera in the logs, which detectors and landmarks need; name "
                "its topic under [topics], or leave them out"
            )
    return camera


class _Reading:
    """The camera of a drive, with its ledger, time segments and chosen clock."""

    def __init__(
        self,
        logs: Sequence[Log],
        camera: tuple[int, Topic],
        vehicle: Vehicle,
        selection: Selection,
        timeline: Timeline | None,
    ) -> None:
        self.logs = logs
        self.number, self.topic = camera
        self.vehicle = vehicle
        self.selection = selection
        self.ledger = Ledger(log_names(logs)[self.number])
        self._log = logs[self.number]
        self._narrowed = Selection(
            frozenset({self.topic.name}), selection.start_ns, selection.end_ns
        )
        planned = pictures_only(camera)
        clocks = probe_clocks(self._log, planned, vehicle, self.number, self._narrowed)
        self.timeline = timeline or camera_timeline(logs, vehicle, selection, camera)
        self.clock = self.timeline.clock(self.number)
        self.extractor = SampleExtractor(
            planned,
            vehicle,
            self.number,
            self.ledger,
            clocks,
            shift_at=shift_of(self.timeline, self.number),
        )

    def spoil(self, t_ns: int, reason: str, why: str) -> None:
        """Count the picture at a drive time as dropped."""
        log_ns = int(self.clock.log_times(np.array([t_ns]))[0])
        self.ledger.spoil(self.topic.name, reason, 1, why, log_ns)

    def pass_pictures(self, on_pictures: Callable[[Block], None]) -> None:
        """Read the camera's log and pass every block of pictures to ``on_pictures``."""
        self.extractor.on_pictures = on_pictures
        timed = TimedLog(self._log, self.clock)
        for block in self.ledger.handing_on(timed.read(self.ledger, self._narrowed)):
            for _ in self.extractor(block):
                pass
        for _ in self.extractor.finish():
            pass


def _run_detectors(reading: _Reading, runner: Runner, tables: _Tables) -> None:
    """Run the detectors over all pictures and write the tables."""
    declared = _declared(reading.topic, reading.selection)

    def detect(block: Block) -> None:
        for result in runner(block):
            tables.add(result)
            emit(Progress("detecting", runner.counts.frames, declared, "frames"))

    with tables:
        reading.pass_pictures(detect)


def _manifest(
    reading: _Reading,
    choices: Sequence[DetectorChoice],
    counts: FrameCounts,
    tables: _Tables,
    made: Account,
) -> DetectManifest:
    """Return the manifest of the detect stage."""
    extractor, vehicle = reading.extractor, reading.vehicle
    return DetectManifest(
        versions=versions_and_commit(),
        logs=log_rows(reading.logs, tables.run),
        selection=selection_record(reading.selection),
        settings=vehicle,
        camera=reading.topic.name,
        camera_log=reading.number,
        time=time_segments(reading.timeline),
        detectors=_detector_rows(tables.detectors, choices, tables),
        clocks=(clock_rows(extractor.clocks, extractor.watch.reports()),),
        account=made,
        counts=DetectCounts(
            frames=counts.frames,
            objects=tables.objects,
            cues=tables.cue_frames,
        ),
        notices=(
            *gaps_text(reading.timeline.segments),
            *_simulated_only(choices, reading.logs),
            *_without_thresholds(tables.detectors, vehicle),
            *_without_masks(tables.boxes_only, vehicle),
            *tables.notices,
            *tables.size_notices(),
        ),
    )


def _timings(seconds: float, counts: FrameCounts) -> Timings:
    """Return the wall time of the detect stage and how much of its work the cache has saved."""
    detect = DetectTimings(
        seconds=seconds, decoded=counts.decoded, ran=counts.ran, from_cache=counts.from_cache
    )
    return Timings(seconds=seconds, detect=detect)


def _declared(topic: Topic, selection: Selection) -> int | None:
    """Return the number of frames that the log declares; None if a time span is selected."""
    return None if selection.is_timed else topic.declared


def _no_frames(topic: Topic, ledger: Ledger) -> str:
    gone = ledger.topic(topic.name).dropped.total()
    dropped = f" ({gone:,} are damaged)" if gone else ""
    return f"the camera, planned from {topic.name}, found no frames{dropped}"


def _detector_rows(
    named: Sequence[Named], choices: Sequence[DetectorChoice], tables: _Tables
) -> tuple[DetectorRow, ...]:
    """Return the manifest's rows of the detectors, in order."""
    return tuple(
        DetectorRow(
            name=one.name,
            identity=one.detector.identity,
            kind=choice.kind,
            role=tables.roles.get(one.name),
            labels=reportable(one.detector),
            settings=dict(choice.settings),
            min_scores=min_scores_of(one.detector),
            calibrated=calibrated_labels(one.detector),
            with_mask=tuple(sorted(tables.masked.get(one.name, ()))),
            boxes_only=tuple(sorted(tables.boxes_only.get(one.name, ()))),
        )
        for one, choice in zip(named, choices, strict=True)
    )


def _simulated_only(choices: Sequence[DetectorChoice], logs: Sequence[Log]) -> list[str]:
    """Return warnings about embedded networks on a log that was not simulated."""
    if all(map(is_simulated, logs)):
        return []
    return [
        f"warning: {choice.name}: the embedded network knows simulated scenes only, and this log "
        f"is not simulated (no {SIMULATED} next to it); its results mean nothing here; "
        "choose a model with crosscue model list"
        for choice in choices
        if knows_simulated_only(choice)
    ]


def _uncounted(
    named: Sequence[Named], choices: Sequence[DetectorChoice], vehicle: Vehicle
) -> list[str]:
    """Return notices about plug-ins whose labels no cue counts; a network is refused.

    A network's card is then likely wrong, or lacks ``[labels]``. A plug-in states its labels
    itself, and its cue is often written after it.

    Raises:
        VehicleError: No cue counts any label of a network.
    """
    if vehicle.counts_any_label:
        return []
    counted = {label for labels in vehicle.cue_labels().values() for label in labels}
    notices = []
    for one, choice in zip(named, choices, strict=True):
        labels = reportable(one.detector)
        if not labels or not counted.isdisjoint(labels):
            continue
        shown = f"({', '.join(labels[:3])}{', ...' if len(labels) > 3 else ''})"
        near = difflib.get_close_matches(labels[0].replace("_", " "), counted, n=1, cutoff=0.75)
        shown += f"; did you mean {near[0]!r}?" if near else ""
        own = f'[cues.own.NAME] labels = ["{labels[0]}"]'
        if not is_plugin(choice):
            raise VehicleError(
                f"{one.name}: no cue counts any of its {len(labels)} labels {shown}; state what "
                "its classes mean under [labels] in its card, or count them in the vehicle file: "
                f"{own}"
            )
        notices.append(
            f"{one.name}: no cue counts its labels {shown}: detections.parquet has its boxes, and "
            f"the belief does not use them; to count them, state in the vehicle file: {own}"
        )
    return notices


def _without_thresholds(named: Sequence[Named], vehicle: Vehicle) -> list[str]:
    """Return notices about labels without a threshold, fitted or set in the vehicle file."""
    cues, cars = vehicle.cues, vehicle.cars
    by_score = [(cars.labels, cars.score)]
    if cues.kind != "tracks":
        by_score.append((cues.stop_sign_labels, cues.stop_sign_score))
        by_score.append((cues.traffic_light_labels, cues.traffic_light_score))
    open_labels = {label for labels, score in by_score if score is None for label in labels}
    notices = []
    for one in named:
        missing = open_labels.intersection(reportable(one.detector) or ())
        missing -= min_scores_of(one.detector).keys()
        if missing:
            notices.append(
                f"{one.name}: no threshold fitted for {', '.join(sorted(missing))}: they count "
                f"above {MIN_SCORE:.2f}; crosscue fit detector fits one to labelled images"
            )
    return notices


def _without_masks(boxes_only: Mapping[str, Set[str]], vehicle: Vehicle) -> list[str]:
    """Return notices about rules that used boxes where the dissertation uses masks, by detector.

    Args:
        boxes_only: Labels that a detector reported only without masks, by detector.
        vehicle: Settings with the labels of the cues.
    """
    cues, cars = vehicle.cues, vehicle.cars
    heights = {*cues.stop_sign_labels, *cues.traffic_light_labels}
    affected = {
        name: [
            *(["heights of signs and lights are those of boxes"] if labels & heights else []),
            *(
                [
                    "cross traffic is judged by boxes (eq. 15 uses masks), and its cars do not "
                    "count as parked, since only a mask shows where one faces (eq. 16)"
                ]
                if labels & {*cars.labels}
                else []
            ),
        ]
        for name, labels in boxes_only.items()
    }
    return [f"{name}: no masks: {'; '.join(rules)}" for name, rules in affected.items() if rules]


@dataclass(slots=True)
class _Tables:
    """The three tables of a run, written frame by frame."""

    run: RunFolder
    camera: str
    vehicle: Vehicle
    detectors: Sequence[Named]
    drawer: Drawer
    cues: CuePass
    is_for_signs: Sequence[bool]
    timeline: Timeline
    clock: LogClock
    notices: list[str]
    visual: VisualPass | None = None
    objects: dict[str, int] = field(default_factory=dict)
    masked: dict[str, set[str]] = field(default_factory=dict)
    """Labels of objects reported with a mask, by detector."""
    _boxed: dict[str, set[str]] = field(default_factory=dict)
    cue_frames: dict[str, int] = field(default_factory=dict)
    _sinks: dict[str, LabelledSink] = field(default_factory=dict)
    _open: ExitStack = field(default_factory=ExitStack)
    roles: dict[str, DetectorRole] = field(default_factory=dict)
    _held: dict[str, list[dict[str, object]]] = field(default_factory=dict)
    _sizes: dict[tuple[int, int], tuple[int, int]] = field(default_factory=dict)
    _frame: int = -1
    _meanings: dict[str, str] = field(default_factory=dict)
    _min_scores: list[dict[str, float]] = field(default_factory=list)
    _labels: frozenset[str] | None = None
    """Labels that the detectors of boxes can report; known from the first frame."""

    @property
    def boxes_only(self) -> dict[str, set[str]]:
        """Labels of objects reported only without masks, by detector."""
        return {name: labels - self.masked.get(name, set()) for name, labels in self._boxed.items()}

    def __enter__(self) -> _Tables:
        with ExitStack() as stack:
            for name, schema in detect_schemas().items():
                if name == VISUAL and self.visual is None:
                    continue
                sink = LabelledSink(self.run, name, schema, self.timeline, self.clock)
                self._sinks[name] = stack.enter_context(sink)
                self._held[name] = []
            self._open = stack.pop_all()
        return self

    def __exit__(self, *failure: object) -> None:
        if failure[0] is not None:
            self._open.__exit__(*failure)  # type: ignore[arg-type]
            return
        with self._open:
            for name in self._sinks:
                self._write(name)

    def size_notices(self) -> list[str]:
        """Return a notice on the sizes of the pictures, if there are several."""
        each = [
            f"{number:,} of {wide} x {high} px from {first_ns} ns on"
            for (wide, high), (number, first_ns) in self._sizes.items()
        ]
        return [f"{self.camera}: pictures of several sizes: {', '.join(each)}"] if each[1:] else []

    def add(self, result: FrameResult) -> None:
        """Add the rows of one frame."""
        number, first_ns = self._sizes.get(result.size_px, (0, result.t_ns))
        self._sizes[result.size_px] = number + 1, first_ns
        self._frame += 1
        if self._frame == 0:
            self.vehicle.camera.check_size(result.size_px)
            self._meanings = label_meanings(self.vehicle)
            self._min_scores = [min_scores_of(one.detector) for one in self.detectors]
            self._labels = all_labels(
                reportable(named.detector)
                for named, found in zip(self.detectors, result.found, strict=True)
                if isinstance(found, Detections)
            )
        once, again = self._without_duplicates(result.found)
        sorted_by_role = seen(result.t_ns, once, self.is_for_signs, self._labels)
        cues = self.cues(sorted_by_role)
        self._held["frames"].append(
            {
                "frame": self._frame,
                "t_ns": result.t_ns,
                "camera": self.camera,
                "width_px": result.size_px[0],
                "height_px": result.size_px[1],
            }
        )
        for number, (named, found, for_signs) in enumerate(
            zip(self.detectors, result.found, self.is_for_signs, strict=True)
        ):
            self.roles[named.name] = detector_role(found, for_signs)
            if isinstance(found, Detections):
                self._held["detections"] += self._detection_rows(named.name, found, again[number])
        road = sorted_by_role.road
        if isinstance(road, RoadMask):
            fractions = cues.road
            if fractions is None or self.vehicle.regions.kind != "picture":
                # The mask is stored, because the ground that it shows is examined later.
                fractions = road_fractions(road, self.vehicle.regions)
            self._held["road"].append(
                {
                    "frame": self._frame,
                    "t_ns": result.t_ns,
                    "camera": self.camera,
                    "fraction_left": fractions.left,
                    "fraction_straight": fractions.straight,
                    "fraction_right": fractions.right,
                    "mask": road.mask,
                    "mask_width_px": road.mask_size_px[0],
                    "mask_height_px": road.mask_size_px[1],
                }
            )
        self._add_cues(result.t_ns, cues)
        if self.visual is not None and (moved := self.visual(result)) is not None:
            self._held[VISUAL].append(moved)
        self.drawer(result.t_ns, result.picture, result.found, cues.counts)
        for name, rows in self._held.items():
            if len(rows) > 8192:
                self._write(name)

    def _add_cues(self, t_ns: int, cues: FrameCues) -> None:
        for cue, count in cues.counts.items():
            row: dict[str, object] = {
                "t_ns": t_ns,
                "approach": None,
                "cue": cue,
                "count": count,
            }
            self._held["cues"].append(row)
            self.cue_frames[cue] = self.cue_frames.get(cue, 0) + (count > 0)

    def _without_duplicates(self, found: Sequence[Found]) -> tuple[list[Found], dict[int, Int64s]]:
        """Return results without duplicates, and by detector who keeps each of its detections.

        The latter is the index of the other detector, or ``KEPT`` for a detector's own.
        """
        numbers = [k for k, one in enumerate(found) if isinstance(one, Detections)]
        boxes = [one for one in found if isinstance(one, Detections)]
        calibrated = [is_calibrated(self.detectors[k].detector) for k in numbers]
        same = same_objects(boxes, self._meanings, calibrated)
        again = dict(zip(numbers, same, strict=True))
        once = [
            one.taken(again[k] == KEPT).with_min_scores(self._min_scores[k])
            if isinstance(one, Detections)
            else one
            for k, one in enumerate(found)
        ]
        names = {k: np.where(one == KEPT, KEPT, np.take(numbers, one)) for k, one in again.items()}
        return once, names

    def _detection_rows(
        self, name: str, found: Detections, again: Int64s
    ) -> list[dict[str, object]]:
        rows: list[dict[str, object]] = []
        for i, label in enumerate(found.labels):
            x0, y0, x1, y1 = found.boxes_px[i].tolist()
            key = f"{name}: {label}"
            self.objects[key] = self.objects.get(key, 0) + 1
            by_mask = self.masked if found.masks[i] else self._boxed
            by_mask.setdefault(name, set()).add(label)
            height = _height_px(found, i)
            ranged = detection_range(self.vehicle, label, found.boxes_px[i], height, found.size_px)
            rows.append(
                {
                    "frame": self._frame,
                    "t_ns": found.t_ns,
                    "camera": self.camera,
                    "detector": name,
                    "label": label,
                    "score": float(found.scores[i]),
                    "x0": x0,
                    "y0": y0,
                    "x1": x1,
                    "y1": y1,
                    "mask": found.masks[i] or None,
                    "height_px": height,
                    "lens": (found.lenses[i] or None) if found.lenses else None,
                    "look": (found.looks[i] or None) if found.looks else None,
                    "same_as": None if again[i] == KEPT else self.detectors[again[i]].name,
                    "range_m": None if ranged is None else ranged.mean_m,
                    "range_sd_m": None if ranged is None else ranged.sd_m,
                    "picture_width_px": found.size_px[0],
                    "picture_height_px": found.size_px[1],
                }
            )
        return rows

    def _write(self, name: str) -> None:
        rows, self._held[name] = self._held[name], []
        if rows:
            self._sinks[name].write({key: [row[key] for row in rows] for key in rows[0]})


def _height_px(found: Detections, i: int) -> float:
    """Return the number of rows that the mask spans, or the height of a box without mask."""
    if not found.masks[i]:
        return float(found.boxes_px[i, 3] - found.boxes_px[i, 1])
    rows = np.flatnonzero(found.mask(i).any(axis=1))
    return float(rows[-1] - rows[0] + 1) if len(rows) else 0.0


def detect_schemas() -> dict[str, pa.Schema]:
    """Return the schemas of the tables that this stage writes."""
    import pyarrow as pa

    number, text = pa.float64(), pa.string()
    return {
        VISUAL: visual_schema(),
        "frames": pa.schema(
            [
                ("frame", pa.int64()),
                ("t_ns", pa.int64()),
                ("camera", text),
                ("width_px", pa.int32()),
                ("height_px", pa.int32()),
            ]
        ),
        "detections": pa.schema(
            [
                ("frame", pa.int64()),
                ("t_ns", pa.int64()),
                ("camera", text),
                ("detector", text),
                ("label", text),
                ("score", number),
                ("x0", number),
                ("y0", number),
                ("x1", number),
                ("y1", number),
                ("mask", pa.binary()),
                ("height_px", number),
                ("lens", text),
                ("look", text),
                ("same_as", text),
                ("range_m", number),
                ("range_sd_m", number),
                ("picture_width_px", pa.int32()),
                ("picture_height_px", pa.int32()),
            ]
        ),
        "road": pa.schema(
            [
                ("frame", pa.int64()),
                ("t_ns", pa.int64()),
                ("camera", text),
                ("fraction_left", number),
                ("fraction_straight", number),
                ("fraction_right", number),
                ("mask", pa.binary()),
                ("mask_width_px", pa.int32()),
                ("mask_height_px", pa.int32()),
            ]
        ),
        "cues": pa.schema(
            [
                ("t_ns", pa.int64()),
                ("approach", pa.int64()),
                ("cue", text),
                ("count", pa.int64()),
            ]
        ),
    }
