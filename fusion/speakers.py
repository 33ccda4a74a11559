"""Ways for cues to speak, by the vehicle file's ``fusion.kind``."""

from __future__ import annotations

from collections.abc import Callable

from crosscue.replay.vehicle.fusion import Fusion

from .belief import Speaker, source_speaker
from .calibrated import CalibratedMessageModel, voices_of
from .factor_graph import FactorGraph
from .persistence import PersistentSpeaker


def speakers_of(graph: FactorGraph, fusion: Fusion) -> Callable[[], Speaker]:
    """What gives each approach its speaker.

    Raises:
        ValueError: ``calibrated`` without what was learned; no vehicle file can say that.
    """
    if fusion.kind == "persistent":
        return lambda: PersistentSpeaker(graph, fusion.dissent)
    if fusion.kind in ("source", None):
        speaker = source_speaker(graph, fusion.dissent)
        return lambda: speaker
    if fusion.calibrated is None:
        raise ValueError("fusion.calibrated: expected what crosscue fit messages wrote, got None")
    voices, size = voices_of(graph, fusion.calibrated), len(graph.features)
    return lambda: CalibratedMessageModel(size, voices)
