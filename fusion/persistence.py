"""Message model in which cues count once they persist, and repeated observations are discounted.

It is meant for real drives, where one false frame in eighty is typical. A positive cue sends a
message under two conditions:

* It was positive in at least k of the last n frames in which it was evaluated. A repeated picture
  is not a new frame, nor is one of a standing car, except for moving objects.
* The intersection is not known to be further away than the cue's validated range.

The message is the published one (eq. 18), sent once per frame regardless of the count, because the
errors of all counted objects have a common cause. Errors of successive frames are correlated. In a
first-order autoregression with correlation ``rho = exp(-distance / fade)``, a frame counts as
(1 - rho) / (1 + rho) independent ones (``effective_sample_fraction``); for moving objects, time
replaces distance. A frame at the position of the previous one therefore adds nothing, and a cue
that remains over a whole approach counts a few times. Dissent is discounted in the same way.
A cue can say how many messages it is worth; a correlated frame then counts by what it is worth more
than all earlier ones.

A cue with ``at_most`` cannot give more than this probability, however long it is seen, until
another cue of the approach supports a feature, too: a light may be a pedestrian crossing's, and no
number of frames tells. Its messages beyond are held back until then.
"""

import math
from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from crosscue.fusion.situation import Situation

from .factor_graph import CueNode, FactorGraph, Messages, cue_messages, log_odds
from .independence import effective_sample_fraction


class Confirmed(NamedTuple):
    """Counts after the test of persistence.

    Attributes:
        counts: Counts without positive cues that were seen too rarely, which are neutral.
        silent: Reason for each of these cues.
    """

    counts: Mapping[str, int]
    silent: Mapping[str, str]


class Persistence:
    """Stores for every cue in which of its last n frames it was positive."""

    def __init__(self, graph: FactorGraph) -> None:
        self._cues = {cue.name: cue for cue in graph.cues}
        self._seen: dict[str, deque[bool]] = {}

    def __call__(self, counts: Mapping[str, int], *, is_new_picture: bool = True) -> Confirmed:
        """Process a frame's counts; a missing cue is neither confirmed nor contradicted."""
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
    """Position of one cue's last message, its greatest weight, and the sum of its messages."""

    positive_at: float = -math.inf
    heaviest: float = 0.0
    dissent_at: float = -math.inf
    held_back: float = 0.0
    given: float = 0.0


@dataclass(frozen=True, slots=True)
class _Line:
    """One cue, precomputed: the features that it affects, and its full message."""

    cue: CueNode
    detected: Messages
    absent: Messages
    sent: _Sent = field(default_factory=_Sent)


class PersistentMessageModel:
    """Message model of one approach, with persistence.

    Attributes:
        silent: Reason for each cue that was positive in the newest frame and sent no message.
    """

    def __init__(self, graph: FactorGraph, dissent: float) -> None:
        self.silent: dict[str, str] = {}
        self._size = len(graph.features)
        self._lines = [_Line(*one) for one in cue_messages(graph, dissent)]
        self._way_m = 0.0
        self._time_s = 0.0
        self._speaking: set[str] = set()

    def __call__(self, situation: Situation) -> list[float]:
        """Return the sum of the messages of one frame, in log odds."""
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
            self._add_messages(line, count > 0, situation, out)
        for line in self._lines:
            # What a cue held back is sent once another cue of the approach has spoken.
            if line.sent.held_back and self._speaking - {line.cue.name}:
                for feature, odds in line.detected:
                    out[feature] += line.sent.held_back * odds
                line.sent.given += line.sent.held_back
                line.sent.held_back = 0.0
        return out

    def withdraw(self, cues: Collection[str]) -> list[float]:
        """Forget what positive cues said, which was about another place; return what undoes it."""
        out = [0.0] * self._size
        for i, line in enumerate(self._lines):
            if line.cue.name in cues:
                for feature, odds in line.detected:
                    out[feature] -= line.sent.given * odds
                self._lines[i] = replace(line, sent=_Sent())
        self._speaking.difference_update(cues)
        return out

    def _add_messages(
        self, line: _Line, is_positive: bool, situation: Situation, out: list[float]
    ) -> None:
        fade = line.cue.fade
        at = self._time_s / fade.time_s if fade.time_s else self._way_m / (fade.way_m or math.inf)
        if is_positive:
            weight = situation.weights.get(line.cue.name, 1.0)
            new = effective_sample_fraction(at - line.sent.positive_at)
            worth = new * weight + (1.0 - new) * max(weight - line.sent.heaviest, 0.0)
            line.sent.positive_at = at
            line.sent.heaviest = max(weight, line.sent.heaviest)
        elif situation.may_dissent:
            worth = effective_sample_fraction(at - line.sent.dissent_at)
            line.sent.dissent_at = at
        else:
            return
        if is_positive and line.detected:
            self._speaking.add(line.cue.name)
            limit, says = line.cue.at_most, log_odds(line.cue.precision)
            if limit is not None and says > 0.0 and self._speaking == {line.cue.name}:
                room = max(log_odds(limit) / says - line.sent.given, 0.0)
                wanted, worth = worth, min(worth, room)
                line.sent.held_back += wanted - worth
            line.sent.given += worth
        for feature, odds in line.detected if is_positive else line.absent:
            out[feature] += worth * odds


def _why_silent(cue: CueNode, situation: Situation) -> str | None:
    if situation.range_m is not None and situation.range_m > cue.within_m:
        return f"intersection further than {cue.within_m:g} m"
    if not (cue.can_start or situation.is_established):
        return "no intersection established"
    return None
