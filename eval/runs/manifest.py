"""The manifest of a run: what it was made of, how, and what became of every row.

One record for each stage that can finish a run folder. ``RunFolder.manifest`` reads one,
``write_manifest`` writes one; ``crosscue run schema`` prints the JSON Schema.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import lru_cache
from textwrap import shorten
from typing import Annotated, Any, Final, Literal, TypeAlias

from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError
from pydantic_core import PydanticCustomError

from crosscue.replay.base import Selection, json_tree
from crosscue.replay.clocks.clock import Clock
from crosscue.replay.files.log_identity import Identity
from crosscue.replay.time.segments import LogClock, Segment, Timeline
from crosscue.replay.vehicle.section import tuples
from crosscue.replay.vehicle.vehicle import Vehicle

from .account import Account, SummedAccount
from .candidates import CandidateRow
from .record import Record

FORMAT_VERSION: Final = 5
LINE: Final = 100
"""Characters of a field that are printed."""
OWN_FRAME: Final = "no start heading and no compass: the map's x axis points where the car did"
"""The notice of a run whose poses are in a frame of its own, turned against any other."""


def _vehicle(given: object) -> object:
    """Settings from JSON, by the rules of the vehicle file: its defaults are tuples."""
    if not isinstance(given, dict):
        return given
    try:
        return _vehicle_of(json.dumps(given))
    except ValidationError as error:
        place, why = _first_of(error)
        raise PydanticCustomError(
            "settings", "{place}: {why}", {"place": place, "why": why}
        ) from None


@lru_cache(maxsize=64)
def _vehicle_of(text: str) -> Vehicle:
    """Most runs of a fleet share their settings, and checking them takes longer than all else."""
    return Vehicle.model_validate(tuples(json_tree(text)))


Settings = Annotated[Vehicle, BeforeValidator(_vehicle)]


def _first_of(error: ValidationError, skip: int = 0) -> tuple[str, str]:
    """Where the first thing lies that does not fit, and why it does not."""
    first = error.errors(include_url=False)[0]
    return ".".join(str(part) for part in first["loc"][skip:]), first["msg"].lower()


class LogRow(Record):
    """One log of a run."""

    name: str
    """File name, made unique within the run."""
    path: str
    """From the run's folder, or a URL."""
    format: str
    identity: Identity
    cameras: tuple[str, ...]
    """Topics with pictures."""
    sha256: dict[str, str]
    """By file; empty for a log that was read by ranges."""
    is_simulated: bool = False
    """Whether ``simulated.json`` lay beside it."""


class Part(Record):
    """The part of the logs that was asked for; None where everything was."""

    start_ns: int | None
    end_ns: int | None
    topics: tuple[str, ...] | None

    @property
    def selection(self) -> Selection:
        """As a log takes it."""
        topics = None if self.topics is None else frozenset(self.topics)
        return Selection(topics, self.start_ns, self.end_ns)


def part_of(selection: Selection) -> Part:
    """A selection as the manifest holds it."""
    topics = None if selection.topics is None else tuple(sorted(selection.topics))
    return Part(start_ns=selection.start_ns, end_ns=selection.end_ns, topics=topics)


class TimeSegments(Record):
    """The drive's time segments and the clock of each log."""

    segments: tuple[Segment, ...]
    clocks: tuple[LogClock, ...]
    notices: tuple[str, ...]


class ClockRow(Record):
    """The clock of one topic."""

    used: Clock
    why: str
    """Judged over the whole log."""
    rows: int
    rate_hz: float | None


class DetectorRow(Record):
    """One detector as it ran."""

    name: str
    identity: str
    """Of weights, settings and code: the same identity finds the same."""
    kind: str
    role: str | None
    """None where it found nothing to report its role by."""
    labels: tuple[str, ...] | None
    """All class names that it can report: none for road, None where it does not say."""
    settings: dict[str, Any]
    min_scores: dict[str, float] = Field(default_factory=dict)
    """From label to the score above which a detection is a cue, as far as the detector says."""
    calibrated: tuple[str, ...] = ()
    """Labels whose scores a fitted calibration has turned into probabilities."""
    with_mask: tuple[str, ...] = ()
    """Labels of what it found with a mask."""
    boxes_only: tuple[str, ...] = ()
    """Labels of what it found, never with a mask."""


class DetectCounts(Record):
    """Frames and what was found in them."""

    frames: int
    decoded: int
    ran: dict[str, int]
    """Frames by detector."""
    from_cache: dict[str, int]
    objects: dict[str, int]
    """By detector and label."""
    cues: dict[str, int]
    """Frames in which each cue was positive."""


class DetectTimings(Record):
    """Wall time."""

    seconds: float


class EstimateCounts(Record):
    """What became of what the pose was estimated from, by the counters of its parts."""

    odometry: dict[str, int]
    track: dict[str, int]
    landmarks: dict[str, int]
    gnss: dict[str, int] = Field(default_factory=dict)
    """Of positions weighed in; empty unless ``gnss.use`` is ``fuse``."""


class LandmarksUsed(Record):
    """The landmark database."""

    database: str
    landmarks: int
    sha256: dict[str, str]


class PoseSummary(Record):
    """The estimated track."""

    rows: int
    travelled_m: float
    major_axis_m: float | None
    """Of the 2-sigma ellipse at the end; None without any pose."""


class ApproachRow(Record):
    """One approach as the run itself saw it; no truth is asked."""

    number: int
    start_ns: int
    end_ns: int
    detected_ns: int | None
    detected_m: float | None
    reference: str | None
    probabilities: dict[str, float]
    not_seen: tuple[str, ...] = ()
    """Features that no cue has said anything about: their probability is the prior."""


class SceneSummary(Record):
    """Cues, ranges and beliefs."""

    frames: int
    positive: dict[str, int]
    counts: dict[str, int]
    without_odometry: int
    approaches: tuple[ApproachRow, ...]
    candidates: dict[str, CandidateRow]
    """By cue, what became of everything that could have been it."""
    not_looked_for: dict[str, str]
    """Cues that have no row in the whole run, and why."""
    ranged: dict[str, CandidateRow]
    """By cue, what became of its detections on the way to a range."""


class EstimateTimings(Record):
    """Wall time."""

    seconds: float
    detect_seconds: float


class _Versioned(Record):
    format_version: Literal[5] = FORMAT_VERSION
    versions: dict[str, str]
    """Of crosscue, Python and the libraries that results depend on."""

    def __repr__(self) -> str:
        """One line per field, for a notebook; long values are cut."""
        fields = {name: repr(getattr(self, name)) for name in type(self).model_fields}
        width = max(map(len, fields))
        lines = [
            f"{name:{width}}  {shorten(text, LINE, placeholder=' ...')}"
            for name, text in fields.items()
        ]
        return "\n".join([type(self).__name__, *lines])


class _Drive(_Versioned):
    """What both stages of a drive say."""

    logs: tuple[LogRow, ...]
    selection: Part
    settings: Settings
    clocks: tuple[dict[str, ClockRow], ...]
    """By topic, for each log that was read."""
    time: TimeSegments
    account: Account
    notices: tuple[str, ...]

    @property
    def timeline(self) -> Timeline:
        """The drive's time segments."""
        return Timeline(self.time.segments, self.time.clocks)


class DetectManifest(_Drive):
    """A run whose detect stage has finished, or the part on it of a whole run."""

    stage: Literal["detect"] = "detect"
    camera: str
    """Its topic."""
    camera_log: int
    """Which of ``logs``, from 0."""
    detectors: tuple[DetectorRow, ...]
    counts: DetectCounts
    timings: DetectTimings

    @property
    def detected(self) -> DetectManifest | None:
        """The part on the detect stage: all of it."""
        return self


class EstimateManifest(_Drive):
    """A whole run of one drive."""

    stage: Literal["estimate"] = "estimate"
    sources: dict[str, str | None]
    """From a signal to the log and topic that it came from."""
    counts: EstimateCounts
    landmarks: LandmarksUsed | None
    pose: PoseSummary
    scene: SceneSummary | None
    detect: DetectManifest | None
    """None where no detector ran."""
    timings: EstimateTimings

    @property
    def detected(self) -> DetectManifest | None:
        """The part on the detect stage; None where none ran."""
        return self.detect


class MergedLog(Record):
    """A log of one of many drives."""

    name: str
    identity: Identity


class MergedDrive(Record):
    """One of many drives."""

    name: str
    logs: tuple[MergedLog, ...]
    settings_sha256: str
    is_whole: bool
    rows: dict[str, int]
    """By table."""
    seconds: float
    tables_sha256: str
    tags: dict[str, str] = Field(default_factory=dict)


class MergedManifest(Record):
    """Many drives as one folder of tables."""

    format_version: Literal[5] = FORMAT_VERSION
    stage: Literal["merged"] = "merged"
    tables: tuple[str, ...]
    drives: tuple[MergedDrive, ...]
    failures: dict[str, str]
    """By drive, why there is no run of it."""
    account: SummedAccount
    notices: dict[str, int]
    """In how many drives each was met."""
    versions: dict[str, tuple[str, ...]]
    """All that were used."""


class DecodeManifest(_Versioned):
    """Every stream of a drive as a table; no run."""

    stage: Literal["decode"] = "decode"
    tables: dict[str, str]
    """From a topic to its file."""
    rows: dict[str, int]
    """By file."""
    settings: Settings
    account: Account
    time: TimeSegments


DriveManifest: TypeAlias = DetectManifest | EstimateManifest
Manifest: TypeAlias = DetectManifest | EstimateManifest | MergedManifest | DecodeManifest

_ANY: Final[TypeAdapter[Manifest]] = TypeAdapter(Annotated[Manifest, Field(discriminator="stage")])


class OtherVersionError(ValueError):
    """A manifest that another version of crosscue wrote."""


def parse_manifest(content: bytes) -> Manifest:
    """A manifest from the text of ``manifest.json``.

    Raises:
        OtherVersionError: Of another version; the message says which.
        ValueError: No manifest: not JSON, or a value that does not fit, which is named.
    """
    tree = json_tree(content)
    version = tree.get("format_version") if isinstance(tree, Mapping) else None
    if version != FORMAT_VERSION:
        raise OtherVersionError(f"format {version!r}, this crosscue reads {FORMAT_VERSION}")
    try:
        return _ANY.validate_json(content)
    except ValidationError as error:
        place, why = _first_of(error, skip=1)
        raise ValueError(f"{place or 'stage'}: {why}") from None


def json_schema() -> dict[str, Any]:
    """The JSON Schema of ``manifest.json``."""
    return _ANY.json_schema(mode="serialization")
