"""The manifest of a run: its inputs, settings, results, and the account of every row.

Each stage that can finish a run folder has a record. ``RunFolder.manifest`` reads a manifest,
``write_manifest`` writes it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import lru_cache
from textwrap import shorten
from typing import Annotated, Any, Final, Literal, Self, TypeAlias

from pydantic import BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import PydanticCustomError

from crosscue.replay.base import Selection
from crosscue.replay.clocks.clock import Clock
from crosscue.replay.files.log_identity import Identity
from crosscue.replay.files.tree_text import json_tree
from crosscue.replay.time.segments import LogClock, Timeline, TimeSegment
from crosscue.replay.vehicle.section import tuples
from crosscue.replay.vehicle.vehicle import Vehicle

from .account import Account, SummedAccount
from .candidates import CandidateRow
from .record import Record

FORMAT_VERSION: Final = 8
# Max characters of a printed field.
LINE: Final = 100
# Notice of a run whose poses are in its own frame, rotated against any other.
OWN_FRAME: Final = "no start heading and no compass: the map's x axis points where the car did"


def _vehicle(given: object) -> object:
    """Return settings from JSON, validated by the rules of the vehicle file."""
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
    """Parse settings, cached because most runs of a fleet share them and validation is slow."""
    return Vehicle.model_validate(tuples(json_tree(text)))


Settings = Annotated[Vehicle, BeforeValidator(_vehicle)]


def _first_of(error: ValidationError, skip: int = 0) -> tuple[str, str]:
    """Return the location of the first invalid value, and the reason."""
    first = error.errors(include_url=False)[0]
    return ".".join(str(part) for part in first["loc"][skip:]), first["msg"].lower()


class LogRow(Record):
    """One log of a run."""

    name: str
    """File name, made unique within the run."""
    path: str
    """Path relative to the run's folder, or a URL."""
    format: str
    identity: Identity
    cameras: tuple[str, ...]
    """Topics with pictures."""
    sha256: dict[str, str]
    """Hash by file; empty for a log that was read by ranges."""
    is_simulated: bool = False
    """True if ``simulated.json`` was next to the log."""


class Part(Record):
    """The selected part of the logs; None selects everything."""

    start_ns: int | None
    end_ns: int | None
    topics: tuple[str, ...] | None

    @property
    def selection(self) -> Selection:
        """Selection in the form that logs accept."""
        topics = None if self.topics is None else frozenset(self.topics)
        return Selection(topics, self.start_ns, self.end_ns)


def selection_record(selection: Selection) -> Part:
    """Return a selection in the form of the manifest."""
    topics = None if selection.topics is None else tuple(sorted(selection.topics))
    return Part(start_ns=selection.start_ns, end_ns=selection.end_ns, topics=topics)


class TimeSegments(Record):
    """The drive's time segments and the clock of each log."""

    segments: tuple[TimeSegment, ...]
    clocks: tuple[LogClock, ...]
    notices: tuple[str, ...]


class ClockRow(Record):
    """The clock of one topic."""

    used: Clock
    why: str
    """Reason for the choice, judged over the complete log."""
    rows: int
    rate_hz: float | None


class DetectorRow(Record):
    """One detector that ran."""

    name: str
    identity: str
    """Hash of weights, settings and code; equal identities yield equal detections."""
    kind: str
    role: str | None
    """Role of the detector; None if it found nothing that shows its role."""
    labels: tuple[str, ...] | None
    """All class names that it can report: empty for road, None if it does not state them."""
    settings: dict[str, Any]
    min_scores: dict[str, float] = Field(default_factory=dict)
    """Score above which a detection is a cue, by label, where the detector states it."""
    log_ratios: dict[str, tuple[float, ...]] = Field(default_factory=dict)
    """Log likelihood ratio of one box, by label, where the model card states it."""
    calibrated: tuple[str, ...] = ()
    """Labels whose scores a fitted calibration has turned into probabilities."""
    is_calibrated: bool = False
    """True if the detector declares all its scores to be probabilities."""
    with_mask: tuple[str, ...] = ()
    """Labels of detections with a mask."""
    boxes_only: tuple[str, ...] = ()
    """Labels of detections that never had a mask."""

    def with_files(self, named: Callable[[str], str]) -> Self:
        """Return the row with another name of the model card in its settings."""
        card = {name: named(value) for name, value in self.settings.items() if name == "card"}
        return self.model_copy(update={"settings": self.settings | card})


class DetectCounts(Record):
    """Numbers of frames and detections."""

    frames: int
    objects: dict[str, int]
    """Number of detections by detector and label."""
    cues: dict[str, int] = Field(default_factory=dict, exclude=True)
    """Counts of earlier runs, whose detect stage counted cues; no longer written."""


class EstimateCounts(Record):
    """Numbers of the pose filter's inputs by outcome."""

    odometry: dict[str, int]
    track: dict[str, int]
    landmarks: dict[str, int]
    gnss: dict[str, int] = Field(default_factory=dict)
    """Number of GNSS positions by outcome; empty unless ``gnss.use`` is ``fuse``."""


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
    """Major axis of the 2-sigma ellipse at the end; None without any pose."""


class ApproachRow(Record):
    """One approach as the run itself found it, without truth."""

    number: int
    start_ns: int
    end_ns: int
    detected_ns: int | None
    detected_m: float | None
    reference: str | None
    probabilities: dict[str, float]
    not_seen: tuple[str, ...] = ()
    """Features without an observation by any cue; their probability is the prior."""


class SceneSummary(Record):
    """Cues, ranges and beliefs."""

    frames: int
    positive: dict[str, int]
    counts: dict[str, int]
    without_odometry: int
    approaches: tuple[ApproachRow, ...]
    candidates: dict[str, CandidateRow]
    """Candidates of each cue by outcome."""
    not_looked_for: dict[str, str]
    """Reason why a cue has no row in the run, by cue."""
    ranged: dict[str, CandidateRow]
    """Candidates of each cue's range by outcome."""


class _Versioned(Record):
    format_version: Literal[8] = FORMAT_VERSION
    versions: dict[str, str]
    """Versions of crosscue, Python and the libraries that results depend on."""
    settings: Settings

    def with_files(self, named: Callable[[str], str]) -> Self:
        """Return the manifest with other names of the files in its settings."""
        return self.model_copy(update={"settings": self.settings.with_files(named)})

    def __repr__(self) -> str:
        """Return one line per field, for a notebook; long values are truncated."""
        fields = {name: repr(getattr(self, name)) for name in type(self).model_fields}
        width = max(map(len, fields))
        lines = [
            f"{name:{width}}  {shorten(text, LINE, placeholder=' ...')}"
            for name, text in fields.items()
        ]
        return "\n".join([type(self).__name__, *lines])


class _Drive(_Versioned):
    logs: tuple[LogRow, ...]
    selection: Part
    clocks: tuple[dict[str, ClockRow], ...]
    """Clocks by topic, for each log that was read."""
    time: TimeSegments
    account: Account
    notices: tuple[str, ...]

    @property
    def timeline(self) -> Timeline:
        return Timeline(self.time.segments, self.time.clocks)


class DetectManifest(_Drive):
    """A run whose detect stage has finished, or the detect part of a complete run."""

    stage: Literal["detect"] = "detect"
    camera: str
    """Topic of the camera."""
    camera_log: int
    """Index in ``logs`` of the camera's log, from 0."""
    detectors: tuple[DetectorRow, ...]
    counts: DetectCounts

    def with_files(self, named: Callable[[str], str]) -> Self:
        """Return the manifest with other names of the files in its settings."""
        rows = tuple(row.with_files(named) for row in self.detectors)
        return super().with_files(named).model_copy(update={"detectors": rows})

    @property
    def detected(self) -> DetectManifest | None:
        """The detect part, which is this manifest itself."""
        return self


class EstimateManifest(_Drive):
    """A complete run of one drive."""

    stage: Literal["estimate"] = "estimate"
    sources: dict[str, str | None]
    """Log and topic of each signal."""
    counts: EstimateCounts
    landmarks: LandmarksUsed | None
    pose: PoseSummary
    scene: SceneSummary | None
    detect: DetectManifest | None
    """The detect part; None if no detector ran."""
    map_sha256: str | None = None
    """Hash of the map whose cues were used; None without."""

    def with_files(self, named: Callable[[str], str]) -> Self:
        """Return the manifest with other names of the files in its settings."""
        detect = None if self.detect is None else self.detect.with_files(named)
        return super().with_files(named).model_copy(update={"detect": detect})

    @property
    def detected(self) -> DetectManifest | None:
        """The detect part; None if no detector ran."""
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
    """Number of rows by table."""
    seconds: float
    tables_sha256: str
    tags: dict[str, str] = Field(default_factory=dict)


class MergedManifest(Record):
    """Many drives as one folder of tables."""

    format_version: Literal[8] = FORMAT_VERSION
    stage: Literal["merged"] = "merged"
    tables: tuple[str, ...]
    drives: tuple[MergedDrive, ...]
    failures: dict[str, str]
    """Reason why a drive has no run, by drive."""
    account: SummedAccount
    notices: dict[str, int]
    """Number of drives with each notice."""
    versions: dict[str, tuple[str, ...]]
    """All versions used of each library."""


class DecodeManifest(_Versioned):
    """Tables of every stream of a drive, written by ``crosscue decode``; not a run."""

    stage: Literal["decode"] = "decode"
    tables: dict[str, str]
    """File of each topic."""
    rows: dict[str, int]
    """Number of rows by file."""
    account: Account
    time: TimeSegments


class DetectTimings(Record):
    """Wall time and work of the detect stage, which depend on the detection cache."""

    seconds: float
    decoded: int
    """Number of frames whose pictures were decoded."""
    ran: dict[str, int]
    """Number of frames by detector."""
    from_cache: dict[str, int]


class Timings(Record):
    """Content of ``timings.json``: what differs between runs of the same input."""

    seconds: float
    """Wall time of the command that finished the run."""
    detect: DetectTimings | None = None
    """The detect stage, which may have run earlier; None if no detector ran."""


DriveManifest: TypeAlias = DetectManifest | EstimateManifest
Manifest: TypeAlias = DetectManifest | EstimateManifest | MergedManifest | DecodeManifest

_ANY: Final[TypeAdapter[Manifest]] = TypeAdapter(
    Annotated[Manifest, Field(discriminator="stage")], config=ConfigDict(defer_build=True)
)


class OtherVersionError(ValueError):
    """A manifest that another version of crosscue wrote."""


@lru_cache(maxsize=4)
def parse_manifest(content: bytes) -> Manifest:
    """Parse the text of ``manifest.json``; cached, as an estimate reads it several times.

    Raises:
        OtherVersionError: The manifest has another version, which the message states.
        ValueError: The text is not JSON, or a value is invalid; the message names the value.
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
