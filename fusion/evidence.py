"""What a frame brings to an approach: ranges, counts of cues, and the way since the last one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from .intersection_range import RangeBelief, Reference


@dataclass(frozen=True, slots=True)
class SignRange:
    """The range that one detected sign or light reports.

    Attributes:
        reference: Whether it is at the start or the end.
        range_m: From the rear axle to there.
        var_m2: How sure that is.
    """

    reference: Reference
    range_m: float
    var_m2: float


@dataclass(frozen=True, slots=True)
class RangePosterior:
    """All that is known of a range, from a tracker that has weighed its observations itself.

    Attributes:
        reference: What it goes to.
        range_m: From the rear axle to there.
        var_m2: Its variance.
        measured_m: What this frame's observation alone says.
    """

    reference: Reference
    range_m: float
    var_m2: float
    measured_m: float


@dataclass(frozen=True, slots=True)
class FrameEvidence:
    """What one frame brings.

    Attributes:
        t_ns: Log time.
        travelled_m: Way since the evidence before, negative in reverse; None where odometry is
            missing.
        travelled_var_m2: Its variance.
        signs: Each detection that reports a range.
        counts: From cue to how many; 0 is looked for and not found, absent is not looked for.
        objects: From cue to identities of the counted things, where a tracker assigns them.
        is_new_picture: Not the same picture as the frame before.
        turned_rad: Change of heading since the evidence before, counter-clockwise, where known.
        assumed_m: How much of the way was assumed across a gap in time: on it nobody looked, so no
            approach becomes stale by it.
        posteriors: Ranges by all observations so far, which the belief takes up along the way.
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


PastCues = Callable[[RangeBelief | None, Reference | None], Mapping[str, int]]
"""Cues that need to know where the intersection is: from the best range to counts."""
