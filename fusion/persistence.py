"""Cues that are believed once they persist, and not again and again for the same thing.

For real drives, where one false frame in eighty is usual. A detection speaks if

* the cue was positive in at least k of the last n frames in which it was looked for; a picture seen
  before is not a new frame;
* the intersection is not known to be further away than the cue was ever validated.

Then it sends its published message (eq. 18), once a frame however many things it counts, since one
cause makes all of them false. Errors of successive frames resemble each other: as in a first-order
autoregression with correlation ``rho = exp(-way / fade)``, a frame is worth (1 - rho) / (1 + rho)
independent ones (``effective_sample_fraction``), over time instead of way for what moves by itself.
So a frame from the place of the one before is worth nothing, and a cue that stays over a whole
approach counts a few times. Dissent is discounted in the same manner.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from crosscue.fusion.situation import Situation

from .factor_graph import CueNode, FactorGraph, log_odds
from .independence import effective_sample_fraction


class Confirmed(NamedTuple):
    """What of some counts may be believed.

    Attributes:
        counts: Without positive ones that were not seen often enough: those are neutral.
        silent: From each of these to the reason.
    """

    counts: Mapping[str, int]
    silent: Mapping[str, str]


class Persistence:
    """Remembers of every cue in which of its last n frames it was positive."""

    def __init__(self, graph: FactorGraph) -> None:
        self._cues = {cue.name: cue for cue in graph.cues}
        self._seen: dict[str, deque[bool]] = {}

    def __call__(self, counts: Mapping[str, int], *, is_new_picture: bool = True) -> Confirmed:
        """Take a frame's counts; a cue may be absent, which neither confirms nor contradicts."""
        kept: dict[str, int] = {}
        silent: dict[str, str] = {}
        for name, count in counts.items():
            cue = self._cues.get(name)
            if cue is None:
                continue
            seen = self._seen.setdefault(name, deque(maxlen=cue.of_frames))
            if is_new_picture:
                seen.append(count > 0)
            if count > 0 and sum(seen) < cue.seen_frames:
                silent[name] = f"seen in {sum(seen)} of {cue.seen_frames} frames needed"
            else:
                kept[name] = count
        return Confirmed(kept, silent)

    def restart(self) -> None:
        """Forget all frames."""
        self._seen.clear()


@dataclass(slots=True)
class _Sent:
    """Where one cue sent a message last, on its own fading scale."""

    positive_at: float = -math.inf
    dissent_at: float = -math.inf


@dataclass(frozen=True, slots=True)
class _Line:
    """One cue, made ready: what a whole message adds to which feature."""

    cue: CueNode
    detected: tuple[tuple[int, float], ...]
    absent: tuple[tuple[int, float], ...]
    sent: _Sent = field(default_factory=_Sent)


class PersistentSpeaker:
    """The cues of one approach.

    Attributes:
        silent: From each cue that was positive in the newest frame and said nothing to the reason.
    """

    def __init__(self, graph: FactorGraph, dissent: float) -> None:
        self.silent: dict[str, str] = {}
        self._size = len(graph.features)
        self._lines = _lines_of(graph, dissent)
        self._way_m = 0.0
        self._time_s = 0.0

    def __call__(self, situation: Situation) -> list[float]:
        """Sum of the messages of one frame, in log odds."""
        out = [0.0] * self._size
        self.silent = {}
        self._way_m += situation.moved_m
        self._time_s += situation.passed_s
        if not situation.is_new_picture:
            return out
        for line in self._lines:
            count = situation.counts.get(line.cue.name)
            if count is None:
                continue
            why = _why_silent(line.cue, situation)
            if why is not None:
                if count > 0:
                    self.silent[line.cue.name] = why
                continue
            self._speak(line, count > 0, situation.may_dissent, out)
        return out

    def _speak(self, line: _Line, is_positive: bool, may_dissent: bool, out: list[float]) -> None:
        fade = line.cue.fade
        at = self._time_s / fade.time_s if fade.time_s else self._way_m / (fade.way_m or math.inf)
        if is_positive:
            worth = effective_sample_fraction(at - line.sent.positive_at)
            line.sent.positive_at = at
        elif may_dissent:
            worth = effective_sample_fraction(at - line.sent.dissent_at)
            line.sent.dissent_at = at
        else:
            return
        for feature, odds in line.detected if is_positive else line.absent:
            out[feature] += worth * odds


def _why_silent(cue: CueNode, situation: Situation) -> str | None:
    if situation.range_m is not None and situation.range_m > cue.within_m:
        return f"intersection further than {cue.within_m:g} m"
    if not (cue.speaks_first or situation.is_established):
        return "no intersection established"
    return None


def _lines_of(graph: FactorGraph, dissent: float) -> tuple[_Line, ...]:
    place = {name: i for i, name in enumerate(graph.feature_names)}
    against = log_odds(dissent)
    lines = []
    for cue in graph.cues:
        edges = [edge for edge in graph.edges if edge.cue == cue.name]
        says = log_odds(cue.precision)
        detected = tuple((place[e.feature], says if e.is_direct else -says) for e in edges)
        absent = tuple((place[e.feature], against) for e in edges if cue.dissents and e.is_direct)
        lines.append(_Line(cue, detected, absent))
    return tuple(lines)
