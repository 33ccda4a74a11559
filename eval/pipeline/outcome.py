"""What stages report: how far into a drive they are, and in the end what they did."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from crosscue.detectors.cues.candidates import Candidates
from crosscue.detectors.runner import Counts
from crosscue.eval.runs.account import Account
from crosscue.eval.runs.folder import RunFolder
from crosscue.replay.base import Ledger
from crosscue.replay.time.segments import ONE_SEGMENT, Segment, Timeline

OnTime = Callable[[float, float], None]
"""Called with the seconds of a drive that are done, and those there are."""


def unwatched_time(_done_s: float, _of_s: float) -> None:
    """Nobody wants to know."""


def report_time(on_time: OnTime, timeline: Timeline, t_ns: int) -> None:
    """Call ``on_time`` for a drive that has been worked through up to ``t_ns``."""
    first, last = timeline.segments[0], timeline.segments[-1]
    if last.end_ns > first.start_ns:
        # The last window ends after the last wheel speed.
        on_time(
            (min(t_ns, last.end_ns) - first.start_ns) * 1e-9, (last.end_ns - first.start_ns) * 1e-9
        )


@dataclass(frozen=True, slots=True)
class DetectOutcome:
    """What a detection run did.

    Attributes:
        run: Its folder.
        ledger: The camera log's account.
        counts: Frames, by detector what ran and what came from the cache.
        objects: Detections by detector and label.
        cues: Frames in which each cue was positive.
        notices: Plain sentences.
        seconds: Wall time.
        account: What became of every row and frame.
        has_gaps: The drive has more than one time segment.
    """

    run: RunFolder
    ledger: Ledger
    counts: Counts
    objects: dict[str, int]
    cues: dict[str, int]
    notices: tuple[str, ...]
    seconds: float
    account: Account
    has_gaps: bool = False

    @property
    def exit_status(self) -> int:
        """3 when anything was dropped or the drive has gaps, else 0."""
        return 0 if self.account.is_whole and not self.has_gaps else 3


@dataclass(slots=True)
class ApproachSummary:
    """One approach as the run itself saw it; no truth is asked.

    Attributes:
        number: From 1 in the order of the drive.
        start_ns: First step.
        end_ns: Last step.
        detected_ns: When the intersection was first held present with a range known.
        detected_m: The range then.
        reference: What that range goes to.
        probabilities: At the last step.
    """

    number: int
    start_ns: int
    end_ns: int
    detected_ns: int | None = None
    detected_m: float | None = None
    reference: str | None = None
    probabilities: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class SceneOutcome:
    """What the scene part did.

    Attributes:
        frames: Looked at.
        positive: Frames in which each cue was positive.
        approaches: In order.
        counts: What became of the evidence, as ``Approaches`` counts it.
        without_odometry: Frames before which the odometry has a hole.
        candidates: By cue, what became of everything that could have been it.
        ranged: By cue, what became of its detections on the way to a range.
        not_looked_for: Cues without any row, and why.
    """

    frames: int
    positive: Mapping[str, int]
    approaches: tuple[ApproachSummary, ...]
    counts: Mapping[str, int]
    without_odometry: int
    candidates: Mapping[str, Candidates] = field(default_factory=dict)
    ranged: Mapping[str, Candidates] = field(default_factory=dict)
    not_looked_for: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a replay, or its second stage alone, did.

    Attributes:
        run: Its folder.
        ledgers: One account for each log.
        rows: Pose rows written.
        travelled_m: Along the estimated track.
        major_axis_m: At the end; NaN without any pose.
        notices: Plain sentences for the person who ran it.
        seconds: Wall time, detection included where it ran.
        drive_seconds: Log time from first to last pose row.
        landmark_counts: What became of camera frames; empty where no landmarks were given.
        account: What became of every row, frame and reading.
        detected: What the detect stage did, where it ran just now.
        scene: Cues, ranges and beliefs, where detectors have run.
        segments: Time segments of the drive.
    """

    run: RunFolder
    ledgers: tuple[Ledger, ...]
    rows: int
    travelled_m: float
    major_axis_m: float
    notices: tuple[str, ...]
    seconds: float
    drive_seconds: float
    landmark_counts: dict[str, int]
    account: Account
    detected: DetectOutcome | None = None
    scene: SceneOutcome | None = None
    segments: tuple[Segment, ...] = ONE_SEGMENT.segments

    @property
    def exit_status(self) -> int:
        """3 when anything was dropped or the drive has gaps, else 0."""
        return 0 if self.account.is_whole and len(self.segments) == 1 else 3
