"""Evidence of one frame: ranges, counts of cues, and the distance since the previous frame."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from .intersection_range import RangeBelief, Reference


@dataclass(frozen=True, slots=True)
class SignRange:
    """Measured range of one detected sign or light.

    Attributes:
        reference: Whether the object is at the intersection's start or end.
        range_m: Distance from the rear axle to the reference.
        var_m2: Variance of the range.
    """

    reference: Reference
    range_m: float
    var_m2: float


@dataclass(frozen=True, slots=True)
class RangePosterior:
    """Posterior of a range, from a tracker that combines all its observations.

    Attributes:
        reference: Reference of the range.
        range_m: Distance from the rear axle to the reference.
        var_m2: Variance of the range.
        measured_m: Range by this frame's observation only.
    """

    reference: Reference
    range_m: float
    var_m2: float
    measured_m: float


@dataclass(frozen=True, slots=True)
class FrameEvidence:
    """Evidence of one frame.

    Attributes:
        t_ns: Log time.
        travelled_m: Distance since the previous evidence, negative in reverse; None without
            odometry.
        travelled_var_m2: Variance of the distance.
        signs: Ranges of all detections that have one.
        counts: Number of objects of each evaluated cue; 0 means searched for and not found.
        objects: Identities of the counted objects by cue, where a tracker assigns them.
        is_new_picture: False if the picture repeats the previous one.
        turned_rad: Change of heading since the previous evidence, counter-clockwise; None where
            unknown.
        assumed_m: Part of the distance that was assumed across a gap in time. It does not make
            evidence stale, because there was no observation on it.
        posteriors: Ranges by all observations so far, which the belief follows over distance.
        weights: Number of messages that a positive cue is worth, by cue; 1 unless stated.
        roads_ahead: By cue, True for a road that is seen, False for one that does not begin ahead,
            or not any more; without those that are unknown.
    """

    t_ns: int
    travelled_m: float | None
    travelled_var_m2: float
    signs: tuple[SignRange, ...]
    counts: Mapping[str, int]
    objects: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    is_new_picture: bool = True
    turned_rad: float | None = None
    assumed_m: float = 0.0
    posteriors: tuple[RangePosterior, ...] = ()
    weights: Mapping[str, float] = field(default_factory=dict)
    roads_ahead: Mapping[str, bool] = field(default_factory=dict)


# Counts cues that depend on the intersection's position, given the best range.
PastCues = Callable[[RangeBelief | None, Reference | None], Mapping[str, int]]
