"""Scores of drives from their tables: coverage, cues, approaches, belief, range.

``score`` scores the tables of one drive. ``score_drive`` compares one with its truth, and
``pool_scores`` pools any number of compared drives.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from crosscue.datasets.truth.truth import Truth
from crosscue.eval.scoring.scene import approaches as score_approaches
from crosscue.eval.scoring.scene import belief as score_belief
from crosscue.eval.scoring.scene.approaches import ApproachesJudged, ApproachScore, judge_approaches
from crosscue.eval.scoring.scene.belief import BeliefJudged, BeliefScore, judge_belief
from crosscue.eval.scoring.scene.cues import (
    CueFrames,
    CueScore,
    features_not_looked_for,
    match_cues,
    score_cues,
)
from crosscue.eval.scoring.scene.detection import RULES, Definition
from crosscue.eval.scoring.scene.ranges import RangeJudged, RangeScore, judge_range, score_range
from crosscue.replay.columns import Int64s
from crosscue.replay.errors import SchemaError

from . import intervals
from . import truth as score_truth
from .columns import RunTables
from .pooling import BINS_M
from .run_tables import run_tables
from .truth import DriveTruth

FORMAT: Final = 1
SECTIONS: Final = ("cues", "approaches", "belief", "range")


@dataclass(frozen=True, slots=True)
class ScoreSettings:
    """Settings of scores.

    Attributes:
        threshold: Probability above which a feature counts as detected.
        bins_m: Edges of the bins of true range.
        detection: ``confirmed``, or ``published``: the first frame counts, with any range.
    """

    threshold: float = score_approaches.THRESHOLD
    bins_m: tuple[float, ...] = BINS_M
    detection: Definition = "confirmed"

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: A value is out of range.
        """
        if not 0.0 < self.threshold < 1.0:
            raise ValueError(f"threshold: expected in (0, 1), got {self.threshold}")
        if self.detection not in RULES:
            raise ValueError(f"detection: expected {' or '.join(RULES)}, got {self.detection}")
        if len(self.bins_m) < 2 or (np.diff(self.bins_m) <= 0.0).any():
            raise ValueError(f"bins_m: expected two or more increasing edges, got {self.bins_m}")


DEFAULTS: Final = ScoreSettings()


@dataclass(frozen=True, slots=True)
class DriveCoverage:
    """Coverage of a drive by its truth.

    Attributes:
        drive: Name of the drive.
        frames: Number of frames in the run.
        frames_ambiguous: Number of frames without truth because their log time occurs twice.
        frames_annotated: Number of frames with truth.
        truth_s: Duration of the truth.
        truth_covered_s: Duration of the truth that the run covers.
        not_scored: Reasons by name of the sections that were not scored at all.
    """

    drive: str
    frames: int
    frames_ambiguous: int
    frames_annotated: int
    truth_s: float
    truth_covered_s: float
    not_scored: dict[str, str]


@dataclass(frozen=True, slots=True)
class DriveJudged:
    """One drive, compared with its truth."""

    coverage: DriveCoverage
    cues: tuple[CueFrames, ...]
    approaches: ApproachesJudged | None
    belief: tuple[BeliefJudged, ...]
    ranges: tuple[RangeJudged, ...]


@dataclass(frozen=True, slots=True)
class PooledScores:
    """Scores of all drives together.

    Attributes:
        settings: Settings of the scores.
        drives: Coverage of each drive.
        cues: Scores by cue.
        approaches: Scores of approaches; None if no drive has any.
        belief: Scores by feature.
        range: Scores by reference.
    """

    settings: ScoreSettings
    drives: tuple[DriveCoverage, ...]
    cues: dict[str, CueScore]
    approaches: ApproachScore | None
    belief: dict[str, BeliefScore]
    range: dict[str, RangeScore]

    def not_scored(self) -> dict[str, str]:
        """Reasons by name of the sections that no drive has."""
        return {
            section: self.drives[0].not_scored[section]
            for section in SECTIONS
            if all(section in one.not_scored for one in self.drives)
        }


def score_drive(
    tables: RunTables, truth: DriveTruth, settings: ScoreSettings = DEFAULTS
) -> DriveJudged:
    """Compare one drive with its truth.

    Raises:
        SchemaError: Their times do not overlap: the truth belongs to another log or clock.
    """
    covered_s = _check_fits(tables, truth)
    cues = tuple(match_cues(tables, truth))
    approaches = judge_approaches(
        tables, truth, settings.threshold, settings.detection, features_not_looked_for(tables)
    )
    belief, ranges = tuple(judge_belief(tables, truth)), tuple(judge_range(tables, truth))
    frames = _frames(tables)
    ambiguous = tables.ambiguous.get("frames", 0)
    coverage = DriveCoverage(
        drive=truth.drive,
        frames=len(frames) + ambiguous,
        frames_ambiguous=ambiguous,
        frames_annotated=int(truth.is_annotated(frames).sum()),
        truth_s=(truth.truth.end_ns - truth.truth.start_ns) * 1e-9,
        truth_covered_s=covered_s,
        not_scored=_not_scored(tables, truth),
    )
    return DriveJudged(coverage, cues, approaches, belief, ranges)


def _frames(tables: RunTables) -> Int64s:
    parts = [np.empty(0, np.int64)]
    parts += [] if tables.frames_ns is None else [tables.frames_ns]
    parts += [] if tables.cues is None else [tables.cues.t_ns]
    return np.unique(np.concatenate(parts))


def _check_fits(tables: RunTables, truth: DriveTruth) -> float:
    """Return the duration of the truth that the run covers, in seconds."""
    span, reported = tables.span_ns(), truth.truth
    if span is None:
        return 0.0
    if span[1] < reported.start_ns or span[0] >= reported.end_ns:
        raise SchemaError(
            f"{truth.drive}: its truth covers {reported.start_ns} to {reported.end_ns} ns, "
            f"the run of {span[0]} to {span[1]} ns; it belongs to "
            "another log or clock; use the truth of this log"
        )
    return (min(span[1], reported.end_ns) - max(span[0], reported.start_ns)) * 1e-9


def _not_scored(tables: RunTables, truth: DriveTruth) -> dict[str, str]:
    reported = truth.truth
    found: dict[str, str] = {}
    if tables.cues is None:
        found["cues"] = "the run has no cues"
    elif not reported.cues and not reported.approaches:
        found["cues"] = "the truth has neither cues nor approaches"
    for section, table in (
        ("approaches", tables.belief),
        ("belief", tables.belief),
        ("range", tables.ranges),
    ):
        if table is None:
            what = "range" if section == "range" else "belief"
            found[section] = f"the run has no {what}"
        elif not reported.approaches:
            found[section] = "the truth has no approaches"
    if "range" not in found and truth.ranges is None:
        found["range"] = "the truth has neither ranges nor a track"
    return found


def score(
    tables: Mapping[str, pa.Table], truth: Truth | DriveTruth, settings: ScoreSettings = DEFAULTS
) -> PooledScores:
    """Score the tables of one drive; no run folder is needed, and nothing is read or written.

    Args:
        tables: Tables ``frames``, ``cues``, ``range`` and ``belief`` with the columns of a run's;
            what a missing one shows is not scored.
        truth: Content of a truth file, or ``read_scored_truth`` with its true ranges, without which
            ranges and distances are not scored.
        settings: Settings of the scores.

    Raises:
        UsageError: A table has another name.
        RunError: A column is missing, or has impossible values.
        SchemaError: Their times do not overlap: the truth belongs to another log or clock.
    """
    if not isinstance(truth, DriveTruth):
        truth = DriveTruth(truth.log or "drive", truth, None)
    return pool_scores([score_drive(run_tables(truth.drive, tables), truth, settings)], settings)


def pool_scores(drives: Sequence[DriveJudged], settings: ScoreSettings = DEFAULTS) -> PooledScores:
    """Score any number of judged drives together.

    Raises:
        ValueError: There is no drive, or two have the same name.
    """
    names = [one.coverage.drive for one in drives]
    if not names or len(set(names)) != len(names):
        raise ValueError(f"drives: expected one or more with different names, got {names}")
    bins_m = settings.bins_m
    return PooledScores(
        settings=settings,
        drives=tuple(one.coverage for one in drives),
        cues=score_cues([cue for one in drives for cue in one.cues], bins_m),
        approaches=score_approaches.score_approaches(
            [one.approaches for one in drives if one.approaches is not None]
        ),
        belief=score_belief.score_belief([part for one in drives for part in one.belief]),
        range=score_range([part for one in drives for part in one.ranges], bins_m),
    )


def as_metrics(scores: PooledScores) -> dict[str, Any]:
    """Return the scores as plain values, as in ``metrics.json``, coverage first."""
    tree = asdict(scores)
    return {
        "format": FORMAT,
        "coverage": {
            "drives": len(scores.drives),
            "frames": sum(one.frames for one in scores.drives),
            "frames_ambiguous": sum(one.frames_ambiguous for one in scores.drives),
            "frames_annotated": sum(one.frames_annotated for one in scores.drives),
            "truth_s": sum(one.truth_s for one in scores.drives),
            "truth_covered_s": sum(one.truth_covered_s for one in scores.drives),
            "not_scored": scores.not_scored(),
            "by_drive": tree["drives"],
        },
        "settings": tree["settings"]
        | {
            "confidence": intervals.CONFIDENCE,
            "log_score_clip": score_belief.CLIP,
            "crossing_s": score_truth.CROSSING_NS * 1e-9,
        },
        "cues": tree["cues"],
        "approaches": tree["approaches"],
        "belief": tree["belief"],
        "range": tree["range"],
    }
