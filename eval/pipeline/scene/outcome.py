"""Outcome of the scene part, by approach and by cue."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from crosscue.detectors.cues.candidates import Candidates


@dataclass(slots=True)
class ApproachSummary:
    """One approach as the run itself found it, without truth.

    Attributes:
        number: Number from 1, in the order of the drive.
        start_ns: Time of the first step.
        end_ns: Time of the last step.
        detected_ns: Time at which the intersection was first established with a known range.
        detected_m: Range at that time.
        reference: Reference of that range.
        probabilities: Probabilities at the last step.
        not_seen: Features without an observation by any cue, whose probability is the prior.
    """

    number: int
    start_ns: int
    end_ns: int
    detected_ns: int | None = None
    detected_m: float | None = None
    reference: str | None = None
    probabilities: Mapping[str, float] = field(default_factory=dict)
    not_seen: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SceneOutcome:
    """Outcome of the scene part.

    Attributes:
        frames: Number of frames processed.
        positive: Number of frames in which each cue was positive.
        approaches: Approaches in order.
        counts: Counts of the evidence, from ``Approaches``.
        without_odometry: Number of frames preceded by a hole in the odometry.
        candidates: Candidates of each cue by outcome.
        ranged: Candidates of each cue's range by outcome.
        not_looked_for: Reason why a cue has no row, by cue.
    """

    frames: int
    positive: Mapping[str, int]
    approaches: tuple[ApproachSummary, ...]
    counts: Mapping[str, int]
    without_odometry: int
    candidates: Mapping[str, Candidates] = field(default_factory=dict)
    ranged: Mapping[str, Candidates] = field(default_factory=dict)
    not_looked_for: Mapping[str, str] = field(default_factory=dict)
