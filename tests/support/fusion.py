"""Random factor graphs, situations for their cues, and evidence for made-up drives."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from hypothesis import strategies as st

from crosscue.detectors.cue_names import Cue
from crosscue.fusion.approaches import FrameEvidence, SignRange
from crosscue.fusion.belief import Situation
from crosscue.fusion.factor_graph import CueNode, Edge, FactorGraph, Feature
from crosscue.fusion.intersection_range import Reference

SECOND_NS = 1_000_000_000
NONE_SEEN: Mapping[str, int] = {cue.value: 0 for cue in Cue if cue not in (Cue.LANES, Cue.VEHICLES)}


@st.composite
def graphs(draw: st.DrawFn) -> FactorGraph:
    """Up to four features and six cues, joined at random."""
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
            CueNode(name, draw(inside), draw(st.booleans()), draw(st.booleans()), dissents=True)
            for name in cues
        ),
        tuple(joined),
    )


@st.composite
def graphs_heard(draw: st.DrawFn) -> tuple[FactorGraph, list[dict[str, int]]]:
    """A graph and what its cues counted in some frames; a cue may not have been looked for."""
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
    moved_m: float | None = 1.0,
) -> Situation:
    """One frame, by default of an established approach that is far away."""
    return Situation(counts, established, near, objects or {}, new_picture, moved_m)


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
    """A car that goes towards an intersection at ten frames a second.

    Args:
        from_m: First distance to the start of the intersection.
        to_m: Last one, below it; negative is past.
        seen: From cue to (distance below which it is seen until passed, how many). A stop sign
            tells its range.
        step_m: Way between frames.
        begin_ns: Time of the first frame.
    """
    frames = int((from_m - to_m) / step_m) + 1
    for i in range(frames):
        ahead_m = from_m - i * step_m
        counts = dict(NONE_SEEN)
        for cue, (within_m, many) in seen.items():
            counts[cue] = many if 0.5 < ahead_m <= within_m else 0
        signs = (sign(ahead_m),) if counts[Cue.STOP_SIGN] else ()
        yield FrameEvidence(begin_ns + i * SECOND_NS // 10, step_m, 1e-4, signs, counts)
