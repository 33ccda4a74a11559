"""Fit each kind of belief to some drives of the study of layouts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from crosscue.eval.fit.annotated_runs import (
    annotated_approaches,
    annotated_drives,
    graph_of_runs,
)
from crosscue.fusion.fit.message_fit import fit_messages
from crosscue.fusion.fit.temporal_fit import AnnotatedDrive, TemporalFit, fit_temporal

from .drives import LayoutDrive

# Annotated approaches by drive.
Annotations = Mapping[str, Sequence[Any]]


class FoldFits(NamedTuple):
    """Fits for the drives of one fold.

    Attributes:
        fusions: Changes to ``Fusion`` by kind of belief.
        base_rates: Frequency of each feature in the training layouts.
        temporal: The belief over time.
    """

    fusions: Mapping[str, Mapping[str, Any]]
    base_rates: Mapping[str, float]
    temporal: TemporalFit


@dataclass(frozen=True, slots=True, eq=False)
class Lessons:
    """Training data of all drives, read once for all folds."""

    approaches: Annotations
    drives: Mapping[str, Sequence[AnnotatedDrive]]


def lessons_of(drives: Sequence[LayoutDrive]) -> Lessons:
    """Read annotated approaches and drives, by drive; the place of a drive is its layout."""
    approaches, parts = {}, {}
    for drive in drives:
        vehicle = drive.run.drive_manifest().settings
        found = annotated_approaches(drive.run, drive.truth, vehicle, Counter())
        approaches[drive.name] = list(found)
        parts[drive.name] = list(annotated_drives(drive.run, drive.truth, vehicle))
    return Lessons(approaches, parts)


def fit_beliefs(drives: Sequence[LayoutDrive], lessons: Lessons) -> FoldFits:
    """Fit all kinds of beliefs to these drives."""
    graph, vehicle = graph_of_runs([one.run for one in drives])
    calibrated = fit_messages(
        [part for one in drives for part in lessons.approaches[one.name]], graph
    ).calibrated
    parts = [part for one in drives for part in lessons.drives[one.name]]
    fitted = fit_temporal(parts, graph)
    by_layout = {one.layout: one.features for one in drives}
    rates = {
        name: float(np.mean([known[name] for known in by_layout.values() if name in known]))
        for name in graph.feature_names
    }
    priors = {
        name: entry.model_copy(update={"prior": min(max(rates[name], 0.01), 0.99)})
        for name, entry in vehicle.fusion.features.items()
    }
    learned = {"kind": "calibrated", "calibrated": calibrated}
    fusions: dict[str, dict[str, Any]] = {
        "source": {"kind": "source"},
        "persistent": {"kind": "persistent"},
        "calibrated": learned,
        "calibrated, base rates": {**learned, "features": priors},
        "temporal": {"kind": "temporal", "temporal": fitted.temporal},
    }
    return FoldFits(fusions, rates, fitted)
