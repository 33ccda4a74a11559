"""Outcomes of the stages, with their text and JSON output."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Final

from crosscue.eval.runs.account import Account, account_lines, details_of
from crosscue.eval.runs.candidates import candidate_lines, not_looked_lines
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.manifest import ApproachRow, SceneSummary
from crosscue.replay.ledger import Ledger
from crosscue.replay.safe_text import counted, terminal_width, visible, wrapped
from crosscue.replay.time.segments import ONE_SEGMENT, TimeSegment
from crosscue.results import HIDDEN, Result, json_key

if TYPE_CHECKING:
    from crosscue.detectors.runner import FrameCounts

# Lines of a result that are printed without --verbose.
MAX_LINES: Final = 25


@dataclass(frozen=True, slots=True, repr=False)
class DetectOutcome(Result):
    """Outcome of the detect stage; its text is the output of ``crosscue detect``.

    Attributes:
        run: The run folder.
        ledger: Ledger of the camera's log.
        counts: Number of frames, and for each detector of frames run and read from the cache.
        objects: Number of detections by detector and label.
        notices: Notices for the user.
        seconds: Wall time.
        account: Account of every row and frame.
        has_gaps: True if the drive has more than one time segment.
    """

    run: RunFolder = field(metadata=HIDDEN)
    ledger: Ledger = field(metadata=HIDDEN)
    counts: FrameCounts = field(metadata=HIDDEN)
    objects: dict[str, int]
    notices: tuple[str, ...]
    seconds: float
    account: Account
    has_gaps: bool = field(default=False, metadata=HIDDEN)

    also: ClassVar = {
        "run": "run.path",
        "frames": "counts.frames",
        "ran": "counts.ran",
        "from_cache": "counts.from_cache",
    }

    @property
    def exit_status(self) -> int:
        """3 when anything was dropped or the drive has gaps, else 0."""
        return 0 if self.account.is_whole and not self.has_gaps else 3

    def lines(self) -> Iterator[str]:
        """Yield counts of frames and objects, and the account."""
        counts, ledger = self.counts, self.ledger
        yield f"run      {self.run.path}"
        yield f"log      {ledger.log}"
        yield f"frames   {counts.frames:,} in {self.seconds:.2f} s"
        for name, ran in counts.ran.items():
            yield f"  {name}: ran on {ran:,}, {counts.from_cache[name]:,} from the cache"
        yield from (f"found    {what}: {count:,}" for what, count in sorted(self.objects.items()))
        yield from (*account_lines(self.account), *details_of([ledger]))
        yield from (f"note     {sentence}" for sentence in (*ledger.notices, *self.notices))


@dataclass(frozen=True, slots=True, repr=False)
class Outcome(Result):
    """Outcome of a replay or an estimate; its ``repr`` is the output of ``crosscue replay``.

    Attributes:
        run: The run folder.
        ledgers: Ledger of each log.
        rows: Number of pose rows written.
        travelled_m: Length of the estimated track.
        major_axis_m: Major axis of the 2-sigma ellipse at the end; NaN without any pose.
        notices: Notices for the user.
        seconds: Wall time, including detection if it ran.
        drive_seconds: Log time from the first to the last pose row, without gaps.
        landmark_counts: Number of camera frames by outcome; empty without landmarks.
        account: Account of every row, frame and reading.
        detected: Outcome of the detect stage, if it ran just now.
        scene: Cues, ranges and beliefs, if detectors have run.
        segments: Number of time segments of the drive.
    """

    run: RunFolder = field(metadata=HIDDEN)
    ledgers: tuple[Ledger, ...] = field(metadata=HIDDEN)
    rows: int = field(metadata=HIDDEN)
    travelled_m: float = field(metadata=HIDDEN)
    major_axis_m: float = field(metadata=HIDDEN)
    notices: tuple[str, ...]
    seconds: float
    drive_seconds: float = field(metadata=HIDDEN)
    landmark_counts: dict[str, int] = field(metadata=json_key("landmarks"))
    account: Account
    detected: DetectOutcome | None = field(default=None, metadata=HIDDEN)
    scene: SceneSummary | None = None
    segments: tuple[TimeSegment, ...] = field(default=ONE_SEGMENT.segments, metadata=HIDDEN)

    also: ClassVar = {"run": "run.path", "pose": "pose", "detected": "detection_counts"}
    max_lines: ClassVar = MAX_LINES

    @property
    def exit_status(self) -> int:
        """3 when anything was dropped or the drive has gaps, else 0."""
        return 0 if self.account.is_whole and len(self.segments) == 1 else 3

    @property
    def pose(self) -> dict[str, float]:
        """Rows, length and final uncertainty of the track."""
        return {
            "rows": self.rows,
            "travelled_m": self.travelled_m,
            "major_axis_m": self.major_axis_m,
        }

    @property
    def detection_counts(self) -> dict[str, object] | None:
        """Counts of the detect stage, if it ran just now."""
        if self.detected is None:
            return None
        counts = self.detected.counts
        return {
            "frames": counts.frames,
            "ran": counts.ran,
            "from_cache": counts.from_cache,
            "objects": self.detected.objects,
        }

    def lines(self) -> Iterator[str]:
        """Yield approaches, cues, the pose and the account; only paths exceed 80 columns."""
        width = min(terminal_width(), 80)
        for line in map(visible, _lines_of(self)):
            fits = len(line) <= width or line.startswith(("run ", "log "))
            yield line if fits else wrapped(line[9:], width, lead=line[:9])


def _lines_of(outcome: Outcome) -> list[str]:
    account = [*account_lines(outcome.account), *details_of(_ledgers(outcome))]
    lines = [] if outcome.scene is None else _found(outcome.scene)
    if outcome.rows:
        lines += [
            f"pose     {counted(outcome.rows, 'row')} over {outcome.travelled_m:.0f} m in "
            f"{outcome.drive_seconds:.0f} s;",
            f"         2-sigma ellipse {outcome.major_axis_m:.1f} m long at the end",
        ]
    else:
        lines.append("pose     none")
    # Losses stay among the first lines, however many approaches there are.
    is_first = not outcome.account.is_whole and len(lines) > MAX_LINES // 3
    lines = [*account, *lines] if is_first else [*lines, *account]
    lines.insert(0, f"run      {outcome.run.path}")
    lines += [f"  note   {sentence}" for sentence in outcome.notices]
    for log in outcome.account.reading:
        lines.append(f"log      {log.log}")
        lines.append(f"         integrity: {log.integrity}")
        lines += [f"  note   {sentence}" for sentence in log.notices]
    if outcome.detected is not None:
        lines += _detected(outcome)
    if outcome.scene is not None:
        lines += _not_used(outcome.scene)
    if outcome.landmark_counts:
        lines.append(f"marks    {_landmarks(outcome.landmark_counts)}")
    speed = outcome.drive_seconds / max(outcome.seconds, 1e-9)
    digits = 0 if speed >= 10 else 1
    lines.append(f"took     {outcome.seconds:.2f} s, {speed:.{digits}f} times real time")
    return lines


def _ledgers(outcome: Outcome) -> list[Ledger]:
    detected = () if outcome.detected is None else (outcome.detected.ledger,)
    return [*detected, *outcome.ledgers]


def _detected(outcome: Outcome) -> list[str]:
    assert outcome.detected is not None
    counts = outcome.detected.counts
    lines = [f"frames   {counts.frames:,} examined"]
    for name, ran in counts.ran.items():
        lines.append(f"         {name}: ran on {ran:,}, {counts.from_cache[name]:,} from the cache")
    return lines


def _found(scene: SceneSummary) -> list[str]:
    seen = [f"{cue} {count:,}" for cue, count in scene.positive.items()]
    lines = [f"approach {_approach(one)}" for one in scene.approaches]
    return [*lines, f"cues     {', '.join(seen) or 'none'} (frames each, of {scene.frames:,})"]


def _not_used(scene: SceneSummary) -> list[str]:
    """Return the output lines on detections that did not count, and cues not looked for."""
    rows = candidate_lines(scene.candidates, scene.ranged)
    lines = [f"  skip   {sentence}" for sentence in rows]
    lines += [f"  skip   {sentence}" for sentence in not_looked_lines(scene.not_looked_for)]
    return [*lines, *(f"  note   {n:,} x {what}" for what, n in scene.counts.items() if n)]


def _approach(one: ApproachRow) -> str:
    features = ", ".join(
        f"{feature} not seen" if feature in one.not_seen else f"{feature} {p:.2f}"
        for feature, p in one.probabilities.items()
    )
    where = "not detected"
    if one.detected_m is not None:
        where = f"detected {one.detected_m:.1f} m before its {one.reference}"
    return f"{one.number}: {where}; at the end {features}"


def _landmarks(counts: dict[str, int]) -> str:
    looked = counts["frames"] - counts["thinned"] - counts["late"]
    return (
        f"{counted(counts['accepted'], 'landmark')} used, {counts['gated']} rejected by the gate; "
        f"{counts['matched']} of {counted(looked, 'frame')} examined matched one"
    )
