"""Cross-validate beliefs over layouts: fit each kind to some drives, and test it on the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.eval.fit.annotated_runs import (
    annotated_approaches,
    annotated_drives,
    graph_of_runs,
)
from crosscue.eval.pipeline.scene.variants import scene_tables
from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.eval.scoring.truth import DriveTruth, read_scored_truth
from crosscue.fusion.fit.annotated_approach import AnnotatedApproach
from crosscue.fusion.fit.message_fit import fit_messages
from crosscue.fusion.fit.temporal_fit import AnnotatedDrive, TemporalFit, filtered, fit_temporal
from crosscue.replay.columns import Floats
from crosscue.replay.progress import Progress, emit
from crosscue.replay.vehicle.cue_table import groups
from crosscue.replay.vehicle.vehicle import Vehicle

from .score import (
    FEATURES,
    THRESHOLD,
    DriveBelief,
    Flags,
    LayoutScores,
    score_difference,
    score_layouts,
)
from .settings import LayoutStudy

# Kinds of beliefs that are compared. The fourth is the third with the training layouts' frequencies
# as priors, which ``temporal`` also learns.
KINDS: Final = ("source", "persistent", "calibrated", "calibrated, base rates", "temporal")
# The belief over time, also outside approaches, where the other kinds have no belief.
EVERYWHERE: Final = "temporal, every picture"
# The rules for real roads, by section of the vehicle file.
REAL_ROADS: Final = {"regions": "ground", "cars": "tracks", "fusion": "persistent"}
# Section of each rule, and its kind without the rule.
RULES: Final[dict[str, dict[str, str]]] = {
    "range-anchored regions": {"regions": "picture"},
    "motion-compensated trackers": {"cars": "pairs"},
    "persistence": {"fusion": "source"},
}


@dataclass(frozen=True, slots=True, eq=False)
class LayoutDrive:
    """A drive of the study with its truth, and what beliefs are fitted to.

    Attributes:
        name: Name of the drive, from layout and run.
        layout: Name of the layout.
        fold: Fold that it is tested in.
        features: True features of the layout, where known.
        run: The finished run.
        truth: Truth of the drive.
        approaches: Its annotated approaches.
        parts: Its annotated parts.
    """

    name: str
    layout: str
    fold: int
    features: Mapping[str, bool]
    run: RunFolder
    truth: DriveTruth
    approaches: Sequence[AnnotatedApproach]
    parts: Sequence[AnnotatedDrive]

    def settings(self, changes: Mapping[str, Mapping[str, Any]]) -> Vehicle:
        """Return the run's settings with changes by section."""
        vehicle = self.run.drive_manifest().settings
        changed = {
            name: getattr(vehicle, name).model_copy(update=dict(values))
            for name, values in changes.items()
        }
        return vehicle.model_copy(update=changed)

    def believed(
        self, start_m: Floats, probabilities: Floats, established: Flags, is_silent: Flags
    ) -> DriveBelief:
        """Return a belief in pictures of this drive."""
        return DriveBelief(
            self.name, self.layout, self.features, start_m, probabilities, established, is_silent
        )


@dataclass(frozen=True, slots=True)
class FoldFits:
    """Fits for the drives of one fold.

    Attributes:
        fusions: Changes to ``Fusion`` by kind of belief.
        base_rates: Frequency of each feature in the training layouts.
        temporal: The belief over time.
    """

    fusions: Mapping[str, Mapping[str, Any]]
    base_rates: Mapping[str, float]
    temporal: TemporalFit


def open_study_drive(out: Path, study: LayoutStudy, scene: SceneSettings) -> LayoutDrive:
    """Open a drive whose run is finished.

    Raises:
        RunError: The run is missing or damaged.
        AnnotationError: The truth does not fit.
    """
    name, layout = scene.name, scene.layout
    run, truth = open_run(out / "runs" / name), read_scored_truth(out / "drives" / name, name)
    vehicle = run.drive_manifest().settings
    return LayoutDrive(
        name,
        layout,
        study.fold_of(layout),
        study.features_of(layout),
        run,
        truth,
        tuple(annotated_approaches(run, truth, vehicle, Counter())),
        tuple(annotated_drives(run, truth, vehicle)),
    )


def score_layout_study(drives: Sequence[LayoutDrive], *, ablation: bool = True) -> LayoutScores:
    """Score the drives of each fold with beliefs fitted to the other folds, then run ablations.

    Args:
        drives: Finished drives.
        ablation: True to also leave out each cue and each rule.
    """
    folds = sorted({one.fold for one in drives})
    learned = {
        fold: fit_beliefs([one for one in drives if one.fold != fold])
        for fold in _counted("learning", "folds", folds)
    }

    def of_kind(kind: str) -> list[DriveBelief]:
        return [
            _in_approaches(
                one,
                one.settings({"fusion": learned[one.fold].fusions[kind]}),
                learned[one.fold].base_rates,
            )
            for one in _counted(f"scoring {kind}", "drives", drives)
        ]

    def with_rules(rule: str) -> list[DriveBelief]:
        kinds = {name: {"kind": kind} for name, kind in (REAL_ROADS | RULES.get(rule, {})).items()}
        return [
            _in_approaches(one, one.settings(kinds), learned[one.fold].base_rates)
            for one in _counted(f"without {rule or 'nothing'}", "drives", drives)
        ]

    def without(cues: Iterable[str]) -> list[DriveBelief]:
        return [_everywhere(one, learned[one.fold].temporal, frozenset(cues)) for one in drives]

    kinds = {kind: of_kind(kind) for kind in KINDS} | {EVERYWHERE: without(())}
    every = kinds[EVERYWHERE]
    left_out = _counted("leaving out cues", "cues", list(groups().items()) if ablation else ())
    rules = {rule: with_rules(rule) for rule in (("", *RULES) if ablation else ())}
    return LayoutScores(
        {kind: score_layouts(some) for kind, some in kinds.items()},
        {
            f"{name} less {kind}": score_difference(kinds[kind], kinds[name])
            for name in ("temporal", EVERYWHERE)
            for kind in KINDS
            if kind != name
        },
        {
            group: score_difference(every, without(cue.name for cue in some))
            for group, some in left_out
        },
        {rule: score_layouts(some) for rule, some in rules.items()},
        {rule: score_difference(rules[""], some) for rule, some in rules.items() if rule},
        len(drives),
        len({one.layout for one in drives}),
        {
            fold: (one.temporal.temporal.exponent, one.temporal.temporal.lapse)
            for fold, one in learned.items()
        },
    )


def fit_beliefs(drives: Sequence[LayoutDrive]) -> FoldFits:
    """Fit all kinds of beliefs to these drives; the place of a drive is its layout."""
    graph, vehicle = graph_of_runs([one.run for one in drives])
    calibrated = fit_messages([some for one in drives for some in one.approaches], graph).calibrated
    fitted = fit_temporal([part for one in drives for part in one.parts], graph)
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


def _in_approaches(
    drive: LayoutDrive, vehicle: Vehicle, base_rates: Mapping[str, float]
) -> DriveBelief:
    """Return the belief in each picture; outside approaches, the base rates."""
    t_ns = np.asarray(drive.run.table("frames", ["t_ns"])["t_ns"], np.int64)
    table = scene_tables(drive.run, vehicle)["belief"]
    at = np.searchsorted(t_ns, np.asarray(table["t_ns"], np.int64))
    probabilities = np.tile([base_rates[name] for name in FEATURES], (len(t_ns), 1))
    probabilities[at] = np.column_stack([np.asarray(table[name], np.float64) for name in FEATURES])
    established, is_silent = np.zeros(len(t_ns), np.bool_), np.ones(len(t_ns), np.bool_)
    established[at], is_silent[at] = np.asarray(table["established"], np.bool_), False
    start_m = drive.truth.start_m(t_ns)
    kept = np.isfinite(start_m) | (not drive.features["intersection"])
    return drive.believed(start_m[kept], probabilities[kept], established[kept], is_silent[kept])


def _everywhere(drive: LayoutDrive, learned: TemporalFit, without: frozenset[str]) -> DriveBelief:
    """Return the belief over time in each picture, inside and outside approaches.

    Ranges from signs that are left out are kept, to separate a cue's evidence on the intersection
    from that on the distance.
    """
    there = drive.features["intersection"]
    part = next(one for one in drive.parts if one.features["intersection"] == there)
    left = {cue: count for cue, count in part.counts.items() if cue not in without}
    probabilities = filtered(replace(part, counts=left), learned.model)
    return drive.believed(
        part.start_m,
        probabilities,
        probabilities[:, 0] > THRESHOLD,
        np.zeros(len(probabilities), np.bool_),
    )


def _counted(doing: str, what: str, some: Sequence[Any]) -> Iterable[Any]:
    """Yield the elements, and emit the progress after each."""
    for done, one in enumerate(some, 1):
        yield one
        emit(Progress(doing, done, len(some), what))
