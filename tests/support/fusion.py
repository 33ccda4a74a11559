"""Random factor graphs, situations of their cues, and evidence of made-up drives."""

import math
from collections.abc import Iterator, Mapping

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from crosscue.fusion.evidence import FrameEvidence, SignRange
from crosscue.fusion.factor_graph import CueNode, Edge, FactorGraph, Feature
from crosscue.fusion.fit.annotated_approach import AnnotatedApproach
from crosscue.fusion.intersection_range import Reference
from crosscue.fusion.situation import Situation
from crosscue.replay.columns import Floats
from crosscue.replay.vehicle.cue_table import CUES

SECOND_NS = 1_000_000_000
NONE_SEEN: Mapping[str, int] = {
    name: 0 for name, cue in CUES.items() if cue.observed_by != "mobileye"
}


@st.composite
def graphs(draw: st.DrawFn) -> FactorGraph:
    """Up to four features and six cues with random edges."""
    features = [f"f{i}" for i in range(draw(st.integers(1, 4)))]
    cues = [f"z{i}" for i in range(draw(st.integers(1, 6)))]
    inside = st.floats(0.02, 0.98)
    joined = [
        Edge(cue, feature, draw(st.booleans()))
        for cue in cues
        for feature in features
        if draw(st.booleans())
    ]
    return FactorGraph(
        tuple(Feature(name, draw(inside), draw(st.booleans())) for name in features),
        tuple(
            CueNode(
                name, draw(inside), draw(st.booleans()), draw(st.booleans()), absence_counts=True
            )
            for name in cues
        ),
        tuple(joined),
    )


@st.composite
def graphs_with_counts(draw: st.DrawFn) -> tuple[FactorGraph, list[dict[str, int]]]:
    """A graph and counts of its cues in several frames; a cue can be missing in a frame."""
    graph = draw(graphs())
    names = st.sampled_from([cue.name for cue in graph.cues])
    frames = st.lists(st.dictionaries(names, st.integers(0, 3)), max_size=5)
    return graph, draw(frames)


def situation(
    counts: Mapping[str, int],
    *,
    established: bool = True,
    near: bool = False,
    objects: Mapping[str, tuple[int, ...]] | None = None,
    new_picture: bool = True,
    moved_m: float = 1.0,
    passed_s: float = 0.1,
) -> Situation:
    """The situation of one frame, by default in an established approach far from its end."""
    return Situation(counts, established, near, near, objects or {}, new_picture, moved_m, passed_s)


def sign(range_m: float, sd_m: float = 1.7) -> SignRange:
    """A stop sign's range."""
    return SignRange(Reference.START, range_m, sd_m**2)


def light(range_m: float, sd_m: float = 5.9) -> SignRange:
    """A traffic light's range."""
    return SignRange(Reference.END, range_m, sd_m**2)


def drive(
    from_m: float,
    to_m: float,
    seen: Mapping[str, tuple[float, int]],
    *,
    step_m: float = 1.0,
    begin_ns: int = 0,
) -> Iterator[FrameEvidence]:
    """Yield the evidence of a car that approaches an intersection, at ten frames per second.

    Args:
        from_m: First distance to the start of the intersection.
        to_m: Last distance; negative after the start of the intersection.
        seen: For each cue, the distance below which it is visible, and its count. A stop sign
            yields a range.
        step_m: Distance between frames.
        begin_ns: Time of the first frame.
    """
    frames = int((from_m - to_m) / step_m) + 1
    for i in range(frames):
        ahead_m = from_m - i * step_m
        counts = dict(NONE_SEEN)
        for cue, (within_m, many) in seen.items():
            counts[cue] = many if 0.5 < ahead_m <= within_m else 0
        signs = (sign(ahead_m),) if counts["stop_sign"] else ()
        yield FrameEvidence(begin_ns + i * SECOND_NS // 10, step_m, 1e-4, signs, counts)


def correlated_positives(
    rng: np.random.Generator, way_m: Floats, rate: float, fade_m: float
) -> NDArray[np.int64]:
    """Simulate a cue along a path: positive at ``rate``, correlated over ``fade_m``."""
    out = [int(rng.random() < rate)]
    for step_m in np.diff(way_m).tolist():
        rho = math.exp(-step_m / fade_m)
        again = rate + (1.0 - rate) * rho if out[-1] else rate * (1.0 - rho)
        out.append(int(rng.random() < again))
    return np.array(out, np.int64)


RATES: Mapping[str, tuple[float, float]] = {
    "road_left": (0.6, 0.15),
    "parked_left": (0.3, 0.05),
    "road_straight": (0.7, 0.2),
}
FADE_M = 4.0


def annotated(seed: int, many: int, frames: int = 60) -> list[AnnotatedApproach]:
    """Simulated approaches whose cues follow ``RATES`` and are correlated over ``FADE_M``."""
    rng = np.random.default_rng(seed)
    out = []
    for i in range(many):
        way_m = np.arange(frames, dtype=np.float64)
        has_left, has_straight = bool(rng.random() < 0.6), bool(rng.random() < 0.6)
        is_there = {"road_left": has_left, "parked_left": has_left, "road_straight": has_straight}
        counts = {
            cue: correlated_positives(rng, way_m, RATES[cue][0 if there else 1], FADE_M)
            for cue, there in is_there.items()
        }
        features = {"intersection": True, "left": has_left, "straight": has_straight}
        always = np.ones(frames, np.bool_)
        near = np.arange(frames) >= frames - 20
        out.append(AnnotatedApproach(way_m, way_m * 0.1, near, always, counts, features, f"L{i}"))
    return out


def other_side(name: str) -> str:
    """Return the name of a cue or feature with left and right exchanged."""
    if "left" in name:
        return name.replace("left", "right")
    return name.replace("right", "left")
