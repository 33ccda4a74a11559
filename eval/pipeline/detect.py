"""The detect stage: from a drive's camera to detections and road in a run folder.

It is the only stage that opens pictures, and it stores what they show. Cues come from what it
stores, in ``estimate``, so a rule or its settings can change without a picture.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np

from crosscue.detectors.base import (
    Detections,
    DetectorChoice,
    Found,
    RoadMask,
    calibrated_labels,
    is_calibrated,
    log_ratios_of,
    min_scores_of,
    reportable,
)
from crosscue.detectors.cues.observed import DetectorRole, detector_role
from crosscue.detectors.cues.road import road_fractions
from crosscue.detectors.cues.same_object import KEPT, label_meanings, same_objects
from crosscue.detectors.overlay import Drawer
from crosscue.detectors.ranging.detection_range import detection_range
from crosscue.detectors.registry import is_plugin, knows_simulated_only, make
from crosscue.detectors.result_cache import ResultCache
from crosscue.detectors.runner import FrameCounts, FrameResult, Named, Runner
from crosscue.eval.pipeline.outcome import DetectOutcome
from crosscue.eval.pipeline.scene.looked_for import uncounted
from crosscue.eval.runs.account import Account, account, detecting_of, reading_of
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import (
    RunFolder,
    write_manifest,
    write_timings,
)
from crosscue.eval.runs.logs import is_simulated, log_names, log_rows
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
from crosscue.replay.errors import VehicleError
from crosscue.replay.files.made_of import SIMULATED
from crosscue.replay.ledger import Ledger
from crosscue.replay.progress import Progress, emit
from crosscue.replay.signals.extractor import SampleExtractor, probe_clocks
from crosscue.replay.signals.plan import pictures_only
from crosscue.replay.time.segments import TimedLog, gaps_text, shift_of
from crosscue.replay.vehicle.vehicle import Vehicle
from crosscue.replay.versions import versions_and_commit

from .clocks import clock_rows
from .detecting import Detecting
from .drive_time import time_segments
from .empty_result import empty_result
from .visual import TABLE as VISUAL
from .visual import VisualPass, uses_pictures


class DetectStage:
    """Detectors over the only camera of a drive, with the tables of a locked run folder."""

    def __init__(self, drive: Drive, run: RunFolder, detecting: Detecting, cache: ResultCache):
        """Build the detectors.

        Raises:
            VehicleError: The drive has several cameras, or a card, weights or settings are invalid.
            EmptyResultError: The drive has no camera.
        """
        self._began = time.monotonic()
        self._drive, self._choices, vehicle = drive, detecting.choices, drive.vehicle
        self._camera = drive.only_camera()
        named = [Named(choice.name, make(choice)) for choice in detecting.choices]
        _refuse_uncounted(named, detecting.choices, vehicle)
        self._pictures = _Pictures(drive, self._camera)
        self._runner = Runner(
            named,
            cache,
            self._pictures.topic.name,
            vehicle.camera.depth_bits,
            self._pictures.spoil,
            vehicle.cues.traffic_light_labels,
            vehicle.cues.stop_sign_labels,
            is_one_size=vehicle.camera.focal_px is not None,
        )
        # Detectors of road declare that they find no objects.
        finds_road = any(reportable(one.detector) == () for one in named)
        is_compared = uses_pictures(drive, finds_road=finds_road)
        self.tables = DetectTables(
            run,
            self._pictures.topic.name,
            drive,
            named,
            Drawer(run.file("pictures"), detecting.draw),
            [choice.kind == "signs" for choice in detecting.choices],
            visual=VisualPass(vehicle) if is_compared else None,
        )

    def frames(self) -> Iterator[FrameResult]:
        """Yield the results of all pictures, in order."""
        topic, counts = self._pictures.topic, self._runner.counts
        # A part of the drive has an unknown number of frames.
        declared = None if self._drive.selection.is_timed else topic.declared
        for block in self._pictures.blocks():
            for result in self._runner(block):
                yield result
                emit(Progress("detecting", counts.frames, declared, "frames"))

    def finish(self) -> DetectOutcome:
        """Write account, timings and manifest.

        Raises:
            EmptyResultError: The selected part contains no frame.
            OutputError: The disk is full.
        """
        drive, tables, pictures = self._drive, self.tables, self._pictures
        counts, ledger, run = self._runner.counts, pictures.ledger, tables.run
        if not counts.frames:
            raise empty_result(_no_frames(pictures.topic, ledger), drive.logs, drive.selection)
        made = account(
            reading_of([ledger]), detecting_of(pictures.topic.name, ledger, counts.frames)
        )
        write_skipped(run, [ledger], made.reading, timeline=drive.segments)
        seconds = time.monotonic() - self._began
        write_timings(run, _timings(seconds, counts))
        manifest = self._manifest(made)
        write_manifest(run, manifest)
        return DetectOutcome(
            run,
            ledger,
            counts,
            tables.objects,
            manifest.notices,
            seconds,
            made,
            drive.segments.has_gaps,
        )

    def _manifest(self, made: Account) -> DetectManifest:
        drive, tables, extractor = self._drive, self.tables, self._pictures.extractor
        return DetectManifest(
            versions=versions_and_commit(),
            logs=log_rows(drive.logs, tables.run),
            selection=selection_record(drive.selection),
            settings=drive.vehicle,
            camera=self._camera[1].name,
            camera_log=self._camera[0],
            time=time_segments(drive.segments),
            detectors=_detector_rows(tables.detectors, self._choices, tables),
            clocks=(clock_rows(extractor.clocks, extractor.watch.reports()),),
            account=made,
            counts=DetectCounts(frames=self._runner.counts.frames, objects=tables.objects),
            notices=(
                *gaps_text(drive.segments.segments),
                *_simulated_only(self._choices, drive.logs),
                *tables.size_notices(),
            ),
        )


class _Pictures:
    def __init__(self, drive: Drive, camera: tuple[int, Topic]) -> None:
        number, self.topic = camera
        self.ledger = Ledger(log_names(drive.logs)[number])
        self._log, part = drive.logs[number], drive.selection
        self._part = Selection(frozenset({self.topic.name}), part.start_ns, part.end_ns)
        self._clock = drive.segments.clock(number)
        planned = pictures_only(camera)
        clocks = probe_clocks(self._log, planned, drive.vehicle, number, self._part)
        self.extractor = SampleExtractor(
            planned,
            drive.vehicle,
            number,
            self.ledger,
            clocks,
            shift_at=shift_of(drive.segments, number),
        )

    def spoil(self, t_ns: int, reason: str, why: str) -> None:
        log_ns = int(self._clock.log_times(np.array([t_ns]))[0])
        self.ledger.spoil(self.topic.name, reason, 1, why, log_ns)

    def blocks(self) -> Iterator[Block]:
        """Read the camera's log and yield every block of pictures."""
        held: list[Block] = []
        self.extractor.on_pictures = held.append
        timed = TimedLog(self._log, self._clock)
        for block in self.ledger.handing_on(timed.read(self.ledger, self._part)):
            for _ in self.extractor(block):
                pass
            yield from held
            held.clear()
        for _ in self.extractor.finish():
            pass
        yield from held


def _timings(seconds: float, counts: FrameCounts) -> Timings:
    """Return the wall time of the detect stage and how much of its work the cache has saved."""
    detect = DetectTimings(
        seconds=seconds, decoded=counts.decoded, ran=counts.ran, from_cache=counts.from_cache
    )
    return Timings(seconds=seconds, detect=detect)


def _no_frames(topic: Topic, ledger: Ledger) -> str:
    gone = ledger.topic(topic.name).dropped.total()
    dropped = f" ({gone:,} are damaged)" if gone else ""
    return f"the camera, planned from {topic.name}, found no frames{dropped}"


def _detector_rows(
    named: Sequence[Named], choices: Sequence[DetectorChoice], tables: DetectTables
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
            log_ratios=log_ratios_of(one.detector),
            calibrated=calibrated_labels(one.detector),
            is_calibrated=is_calibrated(one.detector),
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


def _refuse_uncounted(
    named: Sequence[Named], choices: Sequence[DetectorChoice], vehicle: Vehicle
) -> None:
    """Refuse a network whose labels no cue counts: its card is likely wrong, or lacks ``[labels]``.

    A plug-in states its labels itself, and its cue is often written after it.
    """
    for one, choice in zip(named, choices, strict=True):
        labels = reportable(one.detector)
        why = None if is_plugin(choice) else uncounted(labels, vehicle)
        if labels and why is not None:
            shown, own = why
            raise VehicleError(
                f"{one.name}: no cue counts any of its {len(labels)} labels {shown}; state what "
                "its classes mean under [labels] in its card, or count them in the vehicle file: "
                f"{own}"
            )


@dataclass(slots=True)
class DetectTables:
    """The tables of the stage, written frame by frame."""

    run: RunFolder
    camera: str
    drive: Drive
    detectors: Sequence[Named]
    drawer: Drawer
    is_for_signs: Sequence[bool]
    visual: VisualPass | None = None
    objects: dict[str, int] = field(default_factory=dict)
    masked: dict[str, set[str]] = field(default_factory=dict)
    """Labels of objects reported with a mask, by detector."""
    _boxed: dict[str, set[str]] = field(default_factory=dict)
    _sinks: dict[str, LabelledSink] = field(default_factory=dict)
    _open: ExitStack = field(default_factory=ExitStack)
    roles: dict[str, DetectorRole] = field(default_factory=dict)
    _held: dict[str, dict[str, list[object]]] = field(default_factory=dict)
    _sizes: dict[tuple[int, int], tuple[int, int]] = field(default_factory=dict)
    _frame: int = -1
    _meanings: dict[str, str] = field(default_factory=dict)

    @property
    def boxes_only(self) -> dict[str, set[str]]:
        """Labels of objects reported only without masks, by detector."""
        return {name: labels - self.masked.get(name, set()) for name, labels in self._boxed.items()}

    def __enter__(self) -> DetectTables:
        with ExitStack() as stack:
            timeline = self.drive.segments
            clock = timeline.clock(self.drive.only_camera()[0])
            tables = ("frames", "detections", "road")
            for name in tables if self.visual is None else (VISUAL, *tables):
                sink = LabelledSink(self.run, name, timeline, clock)
                self._sinks[name] = stack.enter_context(sink)
                self._held[name] = {}
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
            self.drive.vehicle.camera.check_size(result.size_px)
            self._meanings = label_meanings(self.drive.vehicle)
        again = self._duplicates(result.found)
        width, height = result.size_px
        self._keep("frames", [result.t_ns], width_px=[width], height_px=[height])
        for number, (named, found, for_signs) in enumerate(
            zip(self.detectors, result.found, self.is_for_signs, strict=True)
        ):
            self.roles[named.name] = detector_role(found, for_signs)
            if isinstance(found, Detections):
                self._keep_detections(named.name, found, again[number])
        road = next((one for one in result.found if isinstance(one, RoadMask)), None)
        if road is not None:
            self._keep_road(road)
        if self.visual is not None and (moved := self.visual(result)) is not None:
            self._extend(VISUAL, {name: [value] for name, value in moved.items()})
        self.drawer(result.t_ns, result.picture, result.found)
        for name, columns in self._held.items():
            if len(columns.get("t_ns", ())) > 8192:
                self._write(name)

    def _keep(self, table: str, times_ns: Sequence[int], **columns: Sequence[object]) -> None:
        """Keep rows of the newest frame, as columns."""
        n = len(times_ns)
        first = {"frame": [self._frame] * n, "t_ns": times_ns, "camera": [self.camera] * n}
        self._extend(table, {**first, **columns})

    def _extend(self, table: str, columns: Mapping[str, Sequence[object]]) -> None:
        held = self._held[table]
        for name, values in columns.items():
            held.setdefault(name, []).extend(values)

    def _duplicates(self, found: Sequence[Found]) -> dict[int, Int64s]:
        """Return by detector who keeps each of its detections.

        That is the index of the other detector, or ``KEPT`` for a detector's own.
        """
        numbers = [k for k, one in enumerate(found) if isinstance(one, Detections)]
        boxes = [one for one in found if isinstance(one, Detections)]
        calibrated = [is_calibrated(self.detectors[k].detector) for k in numbers]
        same = same_objects(boxes, self._meanings, calibrated)
        return {
            k: np.where(one == KEPT, KEPT, np.take(numbers, one))
            for k, one in zip(numbers, same, strict=True)
        }

    def _keep_detections(self, name: str, found: Detections, again: Int64s) -> None:
        n, (width, height), vehicle = len(found), found.size_px, self.drive.vehicle
        for label, mask in zip(found.labels, found.masks, strict=True):
            key = f"{name}: {label}"
            self.objects[key] = self.objects.get(key, 0) + 1
            (self.masked if mask else self._boxed).setdefault(name, set()).add(label)
        heights_px = found.measured().heights_px.tolist()
        ranges = [
            detection_range(vehicle, label, box, high, found.size_px)
            for label, box, high in zip(found.labels, found.boxes_px, heights_px, strict=True)
        ]
        corners = zip(("x0", "y0", "x1", "y1"), found.boxes_px.T.tolist(), strict=True)
        self._keep(
            "detections",
            [found.t_ns] * n,
            detector=[name] * n,
            label=found.labels,
            score=found.scores.tolist(),
            **dict(corners),
            mask=[mask or None for mask in found.masks],
            height_px=heights_px,
            lens=[one or None for one in found.lenses or ("",) * n],
            look=[one or None for one in found.looks or ("",) * n],
            same_as=[None if k == KEPT else self.detectors[k].name for k in again.tolist()],
            range_m=[None if one is None else one.mean_m for one in ranges],
            range_sd_m=[None if one is None else one.sd_m for one in ranges],
            picture_width_px=[width] * n,
            picture_height_px=[height] * n,
        )

    def _keep_road(self, road: RoadMask) -> None:
        fractions = road_fractions(road, self.drive.vehicle.regions)
        self._keep(
            "road",
            [road.t_ns],
            fraction_left=[fractions.left],
            fraction_straight=[fractions.straight],
            fraction_right=[fractions.right],
            mask=[road.mask],
            mask_width_px=[road.mask_size_px[0]],
            mask_height_px=[road.mask_size_px[1]],
        )

    def _write(self, name: str) -> None:
        columns, self._held[name] = self._held[name], {}
        if columns.get("t_ns"):
            self._sinks[name].write(columns)
