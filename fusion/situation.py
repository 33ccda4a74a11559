"""Situation of a frame: the input of a message model."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Situation:
    """All inputs that determine the messages of one frame's cues.

    Attributes:
        counts: Number of objects of each evaluated cue; 0 means searched for and not found.
        is_established: True if earlier frames established presence.
        is_near: True if the intersection is known to be near or passed.
        may_dissent: True if ``is_near`` and the car has moved since dissent was last sent.
        objects: Identities of the counted objects by cue, where a tracker assigns them.
        is_new_picture: False if the picture repeats the previous one.
        moved_m: Distance since the previous frame, regardless of direction.
        passed_s: Time since the previous frame.
        range_m: Distance to the intersection; None where unknown.
        advanced_m: As ``moved_m``, but negative in reverse.
        advanced_var_m2: Variance of ``advanced_m``.
        ranges: Ranges to the intersection's start measured in this frame, with their variances.
        is_standing: True if the car stands; ``counts`` then lacks static cues already seen there.
        weights: Number of messages that a positive cue is worth, by cue; 1 unless stated.
    """

    counts: Mapping[str, int]
    is_established: bool
    is_near: bool = False
    may_dissent: bool = False
    objects: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    is_new_picture: bool = True
    moved_m: float = 0.0
    passed_s: float = 0.0
    range_m: float | None = None
    advanced_m: float = 0.0
    advanced_var_m2: float = 0.0
    ranges: tuple[tuple[float, float], ...] = ()
    is_standing: bool = False
    weights: Mapping[str, float] = field(default_factory=dict)
