"""Frames per second of the fusion, and its belief compared with GTSAM's.

A synthetic drive of ten minutes at ten frames per second passes an intersection every 130 m. The
complete loop has no peer (its range filter is filterpy's). Its belief is compared with GTSAM's
discrete factor graph (the previous belief as priors, a factor for each message, marginals after
each frame). Both alternate within one run, because timings of different runs are not comparable.
Times are CPU times of the process, which a busy machine affects little.
"""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from time import process_time
from typing import Final

import gtsam
import numpy as np

from crosscue.fusion.approaches import Approaches
from crosscue.fusion.belief import begin, multiply, probabilities, published_message_model
from crosscue.fusion.evidence import FrameEvidence, SignRange
from crosscue.fusion.factor_graph import graph_of
from crosscue.fusion.intersection_range import Reference
from crosscue.fusion.situation import Situation
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.fusion import Calibrated, Fusion, RangeFilter, Rates

ROUNDS: Final = 7
FRAMES: Final = 6000
PEER_FRAMES: Final = 600
FRAME_NS: Final = 100_000_000
BETWEEN_M: Final = 130
ZERO: Final = {name: 0 for name, cue in CUES.items() if cue.observed_by != "mobileye"}
SEEN: Final = ("road_left", "road_straight", "parked_left", "cross_traffic_right")


def drive() -> list[FrameEvidence]:
    rng = np.random.default_rng(1)
    out = []
    for i in range(FRAMES):
        ahead_m = 80.0 - i % BETWEEN_M
        counts = dict(ZERO)
        signs: tuple[SignRange, ...] = ()
        if 5.0 < ahead_m < 60.0:
            counts["stop_sign"] = 1
            signs = (SignRange(Reference.START, ahead_m + float(rng.normal(0.0, 1.7)), 2.9),)
        if 0.0 < ahead_m < 40.0:
            counts.update({cue: int(rng.random() < 0.6) for cue in SEEN})
        out.append(FrameEvidence(i * FRAME_NS, 1.0, 1e-4, signs, counts))
    return out


def learned() -> Fusion:
    """Return made-up learned rates for every edge of the default graph."""
    usual = Fusion()
    rates = tuple(
        Rates(cue=name, feature=feature, near=near, if_there=0.5, if_not=0.2)
        for name, cue in usual.cues.items()
        for feature in (*cue.supports, *cue.excludes)
        for near in (False, True)
    )
    return Fusion(kind="calibrated", calibrated=Calibrated(rates=rates))


def loop(evidence: list[FrameEvidence], fusion: Fusion) -> int:
    past = {"lanes_past": 0, "vehicles_past": 1}
    approaches = Approaches(graph_of(fusion), fusion, RangeFilter())
    for one in evidence:
        approaches(one, lambda best, reference: past if best else {})
    return len(evidence)


def our_belief(evidence: list[FrameEvidence]) -> int:
    graph = graph_of(Fusion())
    model, belief = published_message_model(graph, 0.49), begin(graph)
    for one in evidence:
        belief = multiply(belief, model(Situation(one.counts, True)))
        probabilities(belief, graph)
    return len(evidence)


def gtsam_belief(evidence: list[FrameEvidence]) -> int:
    graph = graph_of(Fusion())
    keys = {name: (gtsam.symbol("f", i), 2) for i, name in enumerate(graph.feature_names)}
    precision = {cue.name: cue.precision for cue in graph.cues}
    now = dict.fromkeys(keys, 0.5)
    for one in evidence[:PEER_FRAMES]:
        factors = gtsam.DiscreteFactorGraph()
        for name, p in now.items():
            factors.add(keys[name], [1.0 - p, p])
        for edge in graph.edges:
            for _ in range(one.counts.get(edge.cue, 0)):
                yes = precision[edge.cue] if edge.is_direct else 1.0 - precision[edge.cue]
                factors.add(keys[edge.feature], [1.0 - yes, yes])
        marginals = gtsam.DiscreteMarginals(factors)
        # Clipped away from 0 and 1, from which the product would never return.
        now = {
            name: min(max(float(marginals.marginalProbabilities(key)[1]), 1e-12), 1.0 - 1e-12)
            for name, key in keys.items()
        }
    return PEER_FRAMES


def main() -> None:
    evidence, calibrated = drive(), learned()
    jobs: dict[str, Callable[[], int]] = {
        "whole loop, source": lambda: loop(evidence, Fusion()),
        "whole loop, calibrated": lambda: loop(evidence, calibrated),
        "belief, ours": lambda: our_belief(evidence),
        "belief, GTSAM": lambda: gtsam_belief(evidence),
    }
    taken: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(ROUNDS):
        for name, job in jobs.items():
            began = process_time()
            frames = job()
            taken[name].append(frames / (process_time() - began))
    rates = {name: median(some) for name, some in taken.items()}
    print(f"{'':24} frames/s  median of {ROUNDS}")
    for name, rate in rates.items():
        print(f"{name:24} {rate:9.0f}")
    print(f"belief: {rates['belief, ours'] / rates['belief, GTSAM']:.0f} times GTSAM")
    print(f"ten minutes of drive: {FRAMES / rates['whole loop, source']:.2f} s of loop, source")


if __name__ == "__main__":
    main()
