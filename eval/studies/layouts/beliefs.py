"""Compute beliefs of each kind about drives that they were not fitted to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.pipeline.scene.variants import scene_tables
from crosscue.fusion.fit.temporal_fit import AnnotatedDrive, TemporalFit, filtered
from crosscue.replay.vehicle.vehicle import Vehicle

from .drives import LayoutDrive
from .score import FEATURES, THRESHOLD, DriveBelief

# Kinds of beliefs that are compared. The fourth is the third with the training layouts' frequencies
# as priors, which ``temporal`` also learns.
KINDS: Final = ("source", "persistent", "calibrated", "calibrated, base rates", "temporal")
# The belief over time, also outside approaches, where the other kinds have no belief.
EVERYWHERE: Final = "temporal, every picture"
# The rules for real roads, by section of the vehicle file.
REAL_ROADS: Final[Mapping[str, Mapping[str, str]]] = {
    "regions": {"kind": "ground"},
    "cars": {"kind": "tracks"},
    "fusion": {"kind": "persistent"},
}
# Section of each rule, and its values without the rule.
RULES: Final[Mapping[str, tuple[str, str]]] = {
    "range-anchored regions": ("regions", "picture"),
    "motion-compensated trackers": ("cars", "pairs"),
    "persistence": ("fusion", "source"),
}


def believed(
    drive: LayoutDrive,
    vehicle: Vehicle,
    base_rates: Mapping[str, float],
) -> DriveBelief:
    """Return the belief in each picture; outside approaches, the base rates.

    Args:
        drive: Drive with stored detections.
        vehicle: Settings.
        base_rates: Base rates by feature.
    """
    t_ns = np.asarray(drive.run.table("frames", ["t_ns"])["t_ns"], np.int64)
    table = scene_tables(drive.run, vehicle)["belief"]
    at = np.searchsorted(t_ns, np.asarray(table["t_ns"], np.int64))
    probabilities = np.full((len(t_ns), len(FEATURES)), np.nan)
    for column, name in enumerate(FEATURES):
        probabilities[at, column] = np.asarray(table[name], np.float64)
    established: NDArray[np.bool_] = np.zeros(len(t_ns), np.bool_)
    established[at] = np.asarray(table["established"], np.bool_)
    rates = np.array([base_rates[name] for name in FEATURES])
    is_silent = np.isnan(probabilities[:, 0])
    probabilities[is_silent] = rates
    start_m = drive.truth.start_m(t_ns)
    kept = np.isfinite(start_m) | (not drive.features["intersection"])
    return DriveBelief(
        drive.name,
        drive.layout,
        drive.features,
        start_m[kept],
        probabilities[kept],
        established[kept],
        is_silent[kept],
    )


def believed_everywhere(
    drive: LayoutDrive,
    parts: Sequence[AnnotatedDrive],
    learned: TemporalFit,
    without: frozenset[str] = frozenset(),
) -> DriveBelief:
    """Return the belief over time in each picture, inside and outside approaches.

    Args:
        drive: The drive.
        parts: Its annotated parts.
        learned: Parameters fitted to other drives.
        without: Cues to leave out. Ranges from signs are kept, to separate a cue's evidence on the
            intersection from that on the distance.
    """
    part = next(
        one for one in parts if one.features["intersection"] == drive.features["intersection"]
    )
    left = {cue: count for cue, count in part.counts.items() if cue not in without}
    probabilities = filtered(replace(part, counts=left), learned.model)
    silent = np.zeros(len(probabilities), np.bool_)
    return DriveBelief(
        drive.name,
        drive.layout,
        drive.features,
        part.start_m,
        probabilities,
        probabilities[:, 0] > THRESHOLD,
        silent,
    )


def with_fusion(drive: LayoutDrive, changes: Mapping[str, Any]) -> Vehicle:
    """Return the run's settings with another belief."""
    vehicle = drive.run.drive_manifest().settings
    fusion = vehicle.fusion.model_copy(update=dict(changes))
    return vehicle.model_copy(update={"fusion": fusion})


def with_rules(drive: LayoutDrive, without: str | None = None) -> Vehicle:
    """Return the run's settings with all rules for real roads, or all but one."""
    vehicle = drive.run.drive_manifest().settings
    rules = {name: dict(changes) for name, changes in REAL_ROADS.items()}
    if without is not None:
        section, kind = RULES[without]
        rules[section] = {"kind": kind}
    return vehicle.model_copy(
        update={
            name: getattr(vehicle, name).model_copy(update=changes)
            for name, changes in rules.items()
        }
    )
