"""What the cues of one frame are heard in: all that decides their messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Situation:
    """All that decides what the cues of one frame say.

    Attributes:
        counts: From cue to how many; 0 is looked for and not found, absent is not looked for.
        is_established: Presence was established by earlier frames.
        is_near: The intersection is known to be near, or passed.
        may_dissent: It is, and the car has moved since dissent was last sent.
        objects: From cue to identities of the counted things, where a tracker assigns them.
        is_new_picture: Not the same picture as before.
        moved_m: Way gone since the frame before, forwards or back.
        passed_s: Time since then.
        range_m: To the intersection, as far as known.
        advanced_m: As ``moved_m``, but negative in reverse.
        advanced_var_m2: Its variance.
        ranges: To the start of the intersection as measured in this frame, with their variances.
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
