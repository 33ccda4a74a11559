"""Failures of complete approaches: missed, late or invented features, and flipped beliefs."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.scoring.columns import BeliefRows
from crosscue.eval.scoring.scene.approaches import NEAR_M, ApproachesJudged, Curve, run_spans
from crosscue.eval.scoring.scene.cues import CueFrames
from crosscue.replay.vehicle.cue_table import CUES

from .causes import Finding, approach_findings
from .record import About, Failure, Kind

# Min distance of a probability from 0 and 1, which limits severities to 20 bits.
SURE: Final = 1e-6
EVEN: Final = 0.5
AGAINST: Final = "a cue speaks against it"
NOTHING: Final = "no cue speaks against it"


def bits(probability: float) -> float:
    """Return the surprisal, in bits, of an event with this probability."""
    return -math.log2(min(max(probability, SURE), 1.0))


def of_approaches(
    judged: ApproachesJudged,
    cues: Sequence[CueFrames],
    abouts: Mapping[int, About],
    threshold: float,
) -> Iterator[Failure]:
    """Yield the failures of all approaches of a drive, found by comparison with its truth.

    Args:
        judged: The approaches.
        cues: Cues of the same drive.
        abouts: Descriptions of the approaches, by id.
        threshold: Probability above which a feature counts as believed.
    """
    curves = {one.approach: one for one in judged.curves}
    positives = {one.cue: one.t_ns[one.count > 0] for one in cues}
    for result in judged.results:
        about, curve = abouts[result.approach], curves.get(result.approach)
        for found in approach_findings(result, cues):
            yield from_finding(found, curve, about, threshold)
        if curve is not None:
            yield from flips(curve, positives, about, threshold)


def flips_without_truth(
    belief: BeliefRows, positives: Mapping[str, NDArray[np.int64]], run: str, threshold: float
) -> list[Failure]:
    """Return the flipped beliefs in a run's own approaches.

    Args:
        belief: Belief of the run.
        positives: Times at which a cue was positive, by cue.
        run: Folder of the run.
        threshold: Probability above which an answer counts as decided.
    """
    found: list[Failure] = []
    for number, (first, last) in sorted(run_spans(belief).items()):
        rows = np.flatnonzero(belief.approach == number)
        steps = belief.take(rows[np.argsort(belief.t_ns[rows], kind="stable")])
        unknown = np.full(len(rows), np.nan)
        curve = Curve(run, number, "", steps.t_ns, unknown, steps.features)
        found += flips(curve, positives, About(run, number, "", (), first, last), threshold)
    return found


def from_finding(found: Finding, curve: Curve | None, about: About, threshold: float) -> Failure:
    """Return the failure of a missed, late or invented feature at its clearest moment."""
    kinds: Mapping[str, Kind] = {"missing": "missed", "late": "late", "invented": "false"}
    kind = kinds[found.failing]
    # Without any belief the odds are even.
    whole = _failure(about, kind, found.feature, (found.cause, found.reported), 1.0)
    values = None if curve is None else curve.features.get(found.feature)
    if curve is None or values is None:
        return whole
    if kind == "false":
        row = int(values.argmax())
        rows = np.flatnonzero(values > threshold)
        severity = bits(1.0 - float(values[row]))
    else:
        # The belief at the last moment at which the feature had to be believed.
        far = np.flatnonzero(~(curve.distance_m < NEAR_M))
        row = int(far[-1]) if len(far) else 0
        rows = np.flatnonzero(values <= threshold)
        severity = bits(float(values[row]))
    return replace(_at(whole, curve, row), severity=severity, frames=len(rows))


def flips(
    curve: Curve, positives: Mapping[str, NDArray[np.int64]], about: About, threshold: float
) -> Iterator[Failure]:
    """Yield beliefs that had passed the threshold for one answer and then flipped to the other.

    Args:
        curve: Belief over an approach.
        positives: Times at which a cue was positive, by cue.
        about: The approach.
        threshold: Probability above which an answer counts as decided; a belief without evidence
            is undecided.
    """
    for name, values in curve.features.items():
        for decided, row, is_yes in _crossings(values, threshold):
            later = values[row:] if is_yes else 1.0 - values[row:]
            loud = _against(name, is_yes, positives, int(curve.t_ns[decided]), int(curve.t_ns[row]))
            words = "there" if is_yes else "not there", "not there" if is_yes else "there"
            swing = f"{words[0]} ({values[decided]:.2f}), then {words[1]} ({values[row]:.2f})"
            counts = ", ".join(f"{cue.replace('_', ' ')} in {count}" for cue, count in loud)
            why = (AGAINST, f"{swing}; {counts} frames") if loud else (NOTHING, swing)
            whole = _failure(about, "flipped", name, why, bits(float(later.min())))
            start_ns, end_ns = int(curve.t_ns[decided]), int(curve.t_ns[row])
            flip = replace(whole, start_ns=start_ns, end_ns=end_ns, frames=row - decided + 1)
            yield _at(flip, curve, row)


def _crossings(values: NDArray[np.float64], threshold: float) -> Iterator[tuple[int, int, bool]]:
    """Yield the last row of a decision, the row that reverses it, and whether it was a yes."""
    decided: tuple[int, bool] | None = None
    for row, value in enumerate(values.tolist()):
        if value == values[0]:
            continue
        if decided is not None and (value < EVEN) == decided[1] and value != EVEN:
            yield decided[0], row, decided[1]
            decided = None
        if value > threshold or value < 1.0 - threshold:
            decided = row, value > threshold


def _against(
    feature: str,
    is_yes: bool,
    positives: Mapping[str, NDArray[np.int64]],
    after_ns: int,
    until_ns: int,
) -> Sequence[tuple[str, int]]:
    """Return the cues that indicate the opposite in a time span, with their numbers of frames."""
    found = []
    for cue, times in positives.items():
        if cue in CUES and CUES[cue].claim == (feature, not is_yes):
            count = int(((times > after_ns) & (times <= until_ns)).sum())
            if count:
                found.append((cue, count))
    return sorted(found, key=lambda pair: (-pair[1], pair[0]))


def _at(failure: Failure, curve: Curve, row: int) -> Failure:
    """Return a failure whose clearest moment is a row of the belief."""
    distance_m = float(curve.distance_m[row])
    known_m = distance_m if math.isfinite(distance_m) else None
    return replace(failure, t_ns=int(curve.t_ns[row]), distance_m=known_m)


def _failure(about: About, kind: Kind, what: str, why: tuple[str, str], severity: float) -> Failure:
    """Return a failure of the whole approach, which is clearest at its end."""
    return Failure(
        run=about.run,
        kind=kind,
        level="approach",
        what=what,
        cause=why[0],
        reported=why[1],
        t_ns=about.end_ns,
        start_ns=about.start_ns,
        end_ns=about.end_ns,
        frames=0,
        **about.shared,
        severity=severity,
    )
