"""Ways for cues to speak, by the vehicle file's ``fusion.kind``."""

from __future__ import annotations

from collections.abc import Callable

from crosscue.replay.errors import VehicleError
from crosscue.replay.fusion_settings import Fusion

from .belief import Speaker, source_speaker
from .factor_graph import FactorGraph


def speakers_of(graph: FactorGraph, fusion: Fusion) -> Callable[[], Speaker]:
    """What gives each approach its speaker.

    Raises:
        VehicleError: ``calibrated`` without what was learned.
    """
    if fusion.kind == "calibrated":
        raise VehicleError(
            'fusion.kind = "calibrated" needs [fusion.calibrated]; make it with: '
            "crosscue fit messages"
        )
    speaker = source_speaker(graph, fusion.dissent)
    return lambda: speaker
