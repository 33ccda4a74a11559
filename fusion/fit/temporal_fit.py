"""Fit the parameters of ``fusion.kind = "temporal"`` to annotated drives, by counting.

* A cue's *chain* has its frequency of being positive after a positive step, after a negative one,
  and overall. It depends on the state: no intersection ahead, or the combination of the cue's
  features and the distance. Frequencies are shrunk towards those of all distances, these towards
  those of all states, and these towards one half, each by ``PULL_STEPS`` additional steps. A state
  without observations therefore has the frequencies of the others.
* *Ways* are the frequencies of combinations of outgoing roads. Each place counts once, and each
  combination gets half a place more.
* *Stray* ranges are more than ``STRAY_SD`` standard deviations off; one of two additional ranges is
  counted as stray.
* *Exponent* and *lapse* are the pair of ``EXPONENTS`` and ``LAPSES`` with the best log score in a
  cross-validation over two halves of the places.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.fusion.factor_graph import CueNode, FactorGraph
from crosscue.fusion.temporal import (
    PRESENCE,
    MeasuredRange,
    TemporalFilter,
    TemporalModel,
    temporal_model,
)
from crosscue.replay.vehicle.fusion import CueChain, Temporal

from .annotated_approach import NOT_EVALUATED, Bools

EDGES_M: Final = (0.0, 10.0, 20.0, 35.0, 50.0, 80.0)
# Number of additional steps; about that of a drive, so the effect is that of one more place.
PULL_STEPS: Final = 20.0
STRAY_SD: Final = 3.0
EXPONENTS: Final = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18)
LAPSES: Final = (0.0, 0.02, 0.05, 0.1)
# Minimum distance of a fitted probability from 0 and 1, because rare events can occur.
MIN_RATE: Final = 0.002


@dataclass(frozen=True, slots=True, eq=False)
class AnnotatedDrive:
    """N frames of a drive, with ground truth.

    Attributes:
        advanced_m: Shape (N,): distance since the previous frame, negative in reverse; 0 at first.
        advanced_var_m2: Shape (N,): variance of the distance.
        passed_s: Shape (N,): time since the previous frame.
        start_m: Shape (N,): true distance to the intersection ahead, NaN without one.
        counts: Counts of each cue, shape (N,), or ``NOT_EVALUATED``.
        ranges: Measured ranges to the start in each of the N frames.
        features: True features of the intersection, or of a road without one.
        place: Name of the layout or intersection.
    """

    advanced_m: NDArray[np.float64]
    advanced_var_m2: NDArray[np.float64]
    passed_s: NDArray[np.float64]
    start_m: NDArray[np.float64]
    counts: Mapping[str, NDArray[np.int64]]
    ranges: tuple[tuple[MeasuredRange, ...], ...]
    features: Mapping[str, bool]
    place: str


# What a step of a chain is: after none, a positive and a negative one, as in ``CueChain``.
WHAT: Final = ("first", "stays", "appears")


class TemporalFit(NamedTuple):
    """Result of the fit.

    Attributes:
        temporal: Section of the vehicle file.
        drives: Number of drives.
        places: Number of places.
        steps: Total number of steps in which cues were evaluated.
        model: The same parameters, as arrays for a filter.
        log_scores: Log score of each pair of exponent and lapse.
    """

    temporal: Temporal
    drives: int
    places: int
    steps: int
    model: TemporalModel
    log_scores: Mapping[tuple[float, float], float]


def fit_temporal(drives: Sequence[AnnotatedDrive], graph: FactorGraph) -> TemporalFit:
    """Fit chains, ways, stray ranges, exponent and lapse.

    Raises:
        ValueError: There are fewer than two places, or none has an intersection.
    """
    places = sorted({one.place for one in drives})
    if len(places) < 2 or not any(one.features.get(PRESENCE) for one in drives):
        raise ValueError("expected drives at two places or more, one with an intersection")
    whole = _counted(drives, graph)
    halves = ([d for d in drives if places.index(d.place) % 2 == k] for k in (0, 1))
    scores = _scores(list(halves), graph)
    exponent, lapse = min(scores, key=lambda pair: (scores[pair], pair)) if scores else (1.0, 0.0)
    steps = sum(int(_steps(one, whole).sum()) for one in drives)
    chosen = whole.model_copy(update={"exponent": exponent, "lapse": lapse})
    model = temporal_model(graph, chosen)
    return TemporalFit(chosen, len(drives), len(places), steps, model, scores)


def _scores(
    halves: Sequence[Sequence[AnnotatedDrive]], graph: FactorGraph
) -> dict[tuple[float, float], float]:
    if not all(any(one.features.get(PRESENCE) for one in half) for half in halves):
        return {}
    losses: dict[tuple[float, float], list[float]] = {}
    for half, other in ((0, 1), (1, 0)):
        learned = _counted(halves[other], graph)
        for exponent in EXPONENTS:
            model = temporal_model(graph, learned.model_copy(update={"exponent": exponent}))
            for drive in halves[half]:
                beliefs = filtered(drive, model)
                for lapse in LAPSES:
                    mixed = (1.0 - lapse) * beliefs + lapse * model.usual
                    loss = log_loss(drive, graph, mixed)
                    losses.setdefault((exponent, lapse), []).append(loss)
    return {pair: float(np.mean(some)) for pair, some in losses.items()}


def log_loss(drive: AnnotatedDrive, graph: FactorGraph, beliefs: NDArray[np.float64]) -> float:
    """Mean of -ln(probability of the true value) over frames and known features."""
    losses = [
        -np.log(beliefs[:, column] if drive.features[name] else 1.0 - beliefs[:, column])
        for column, name in enumerate(graph.feature_names)
        if name in drive.features
    ]
    return float(np.mean(losses))


def filtered(drive: AnnotatedDrive, model: TemporalModel) -> NDArray[np.float64]:
    """Probabilities after each frame, shape (N, features)."""
    belief = TemporalFilter(model)
    out = []
    for i, counts in enumerate(frames_of(drive)):
        belief.update(
            counts,
            drive.ranges[i],
            float(drive.advanced_m[i]),
            float(drive.advanced_var_m2[i]),
            float(drive.passed_s[i]),
        )
        out.append(belief.probabilities())
    return np.array(out).reshape(len(drive.start_m), len(model.has_feature))


def frames_of(drive: AnnotatedDrive) -> Iterator[dict[str, int]]:
    """Yield the counts of the evaluated cues of each frame."""
    columns = {name: column.tolist() for name, column in drive.counts.items()}
    for i in range(len(drive.start_m)):
        yield {name: column[i] for name, column in columns.items() if column[i] != NOT_EVALUATED}


def _steps(drive: AnnotatedDrive, about: Temporal) -> Bools:
    """Mark the frames in which the filter evaluates all cues."""
    is_step = np.zeros(len(drive.start_m), np.bool_)
    since_m = np.inf
    for i in range(len(is_step)):
        since_m += abs(drive.advanced_m[i])
        if since_m >= about.step_m:
            is_step[i], since_m = True, 0.0
    return is_step


def _counted(drives: Sequence[AnnotatedDrive], graph: FactorGraph) -> Temporal:
    # A place counts once ahead of its intersection, and once on a part of the road without one.
    ahead = {(one.place, bool(one.features.get(PRESENCE))) for one in drives}
    empty = Temporal(
        ahead=round((sum(there for _, there in ahead) + 1.0) / (len(ahead) + 2.0), 4),
        ways=_ways(drives, graph),
        edges_m=EDGES_M,
        chains=(),
        stray=_stray(drives),
    )
    steps = [(one, _steps(one, empty)) for one in drives]
    chains = tuple(chain for cue in graph.cues for chain in _chains(cue, graph, steps))
    return empty.model_copy(update={"chains": chains})


def _ways(drives: Sequence[AnnotatedDrive], graph: FactorGraph) -> dict[str, float]:
    others = [name for name in graph.feature_names if name != PRESENCE]
    by_place = {
        one.place: "+".join(name for name in others if one.features.get(name)) or "none"
        for one in drives
        if one.features.get(PRESENCE) and all(name in one.features for name in others)
    }
    names = (
        "+".join(name for name, is_there in zip(others, way, strict=True) if is_there) or "none"
        for way in product((True, False), repeat=len(others))
    )
    seen = Counter(by_place.values())
    weights = {name: seen[name] + 0.5 for name in names}
    total = sum(weights.values())
    return {name: round(weight / total, 4) for name, weight in weights.items()}


def _stray(drives: Sequence[AnnotatedDrive]) -> float:
    far = total = 0
    for drive in drives:
        for start_m, ranges in zip(drive.start_m.tolist(), drive.ranges, strict=True):
            if np.isfinite(start_m):
                total += len(ranges)
                far += sum(
                    abs(one.range_m - start_m) > STRAY_SD * one.var_m2**0.5 for one in ranges
                )
    return round((far + 1.0) / (total + 2.0), 4)


def _chains(
    cue: CueNode, graph: FactorGraph, drives: Sequence[tuple[AnnotatedDrive, Bools]]
) -> Iterator[CueChain]:
    """Yield a chain for no intersection, and one for each combination of the cue's features.

    The features are those other than presence that the cue affects, in the graph's order.
    """
    mine = {edge.feature for edge in graph.edges if edge.cue == cue.name} - {PRESENCE}
    features = [name for name in graph.feature_names if name in mine]
    ways: list[tuple[bool | None, ...]] = list(product((True, False), repeat=len(features)))
    # Steps by kind, value, way (none, each combination, not known) and distance.
    counts = np.zeros((len(WHAT), 2, len(ways) + 2, len(EDGES_M) - 1))
    for drive, is_step in drives:
        known = tuple(drive.features.get(name) for name in features)
        way = ways.index(known) + 1 if known in ways else -1
        _count(counts, cue.name, drive, is_step, way)
    if not counts.any():
        return
    usual = _rates(counts.sum(axis=(2, 3)), np.full(len(WHAT), 0.5))
    nowhere = _rates(counts[:, :, 0].sum(axis=2), usual)
    yield CueChain(cue=cue.name, **{what: (nowhere[k],) for k, what in enumerate(WHAT)})
    for row, is_there in enumerate(ways, 1):
        here = _rates(counts[:, :, row].sum(axis=2), usual)
        found = _rates(counts[:, :, row], here[:, None]).tolist()
        sides = [
            tuple(name for name, is_so in zip(features, is_there, strict=True) if is_so == side)
            for side in (True, False)
        ]
        yield CueChain(
            cue=cue.name,
            there=(PRESENCE, *sides[0]),
            missing=sides[1],
            **{what: tuple(rates) for what, rates in zip(WHAT, found, strict=True)},
        )


def _count(
    counts: NDArray[np.float64], cue: str, drive: AnnotatedDrive, is_step: Bools, way: int
) -> None:
    count = drive.counts.get(cue)
    if count is None:
        return
    at = np.searchsorted(EDGES_M[1:-1], drive.start_m, side="right").tolist()
    is_ahead = (np.isfinite(drive.start_m) & (drive.start_m < EDGES_M[-1])).tolist()
    before: bool | None = None
    for i in np.flatnonzero(is_step).tolist():
        if count[i] == NOT_EVALUATED:
            before = None
            continue
        now = bool(count[i] > 0)
        where = (int(now), way, at[i]) if is_ahead[i] else (int(now), 0, 0)
        # The initial probability is counted over all steps, because few are first ones.
        counts[(WHAT.index("first"), *where)] += 1.0
        if before is not None:
            counts[(WHAT.index("stays" if before else "appears"), *where)] += 1.0
        before = now


def _rates(counts: NDArray[np.float64], usual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return frequencies of positive steps; ``counts`` has the kind of step and the value first."""
    rates = (counts[:, 1] + PULL_STEPS * usual) / (counts.sum(axis=1) + PULL_STEPS)
    kept = np.clip(rates, MIN_RATE, 1.0 - MIN_RATE)
    # NumPy's function rounds some ties of decimal numbers the other way.
    return np.array([round(rate, 4) for rate in kept.ravel().tolist()]).reshape(kept.shape)
