"""What the scene stage did, approach by approach and cue by cue."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from crosscue.detectors.cues.candidates import Candidates


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
        not_seen: Features that no cue has said anything about: a probability that is the prior.
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
