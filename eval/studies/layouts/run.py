"""Fit beliefs to random layouts, with and without intersections, and test them on others."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numpy as np

from crosscue.datasets.scenes.drive import Imager
from crosscue.datasets.scenes.faulty_labels import DETECTORS, LABEL_IMAGES
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.eval.batch.jobs import JobOutcome, exit_status_of
from crosscue.eval.batch.ray_jobs import engine_of
from crosscue.eval.fit.annotated_runs import annotated_approaches, annotated_drives, graph_of_runs
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.pipeline.scene.variants import scene_tables
from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.eval.scoring.intervals import Mean, between
from crosscue.eval.scoring.truth import FEATURES, DriveTruth, read_scored_truth
from crosscue.eval.studies.pictures import bare_figure, save_png
from crosscue.eval.studies.simulated_drives import SPARSE_AND_EMBEDDED, run_drives
from crosscue.eval.studies.study import PageTable, StudyResult, Written, without_nan
from crosscue.fusion.fit.annotated_approach import AnnotatedApproach
from crosscue.fusion.fit.combined_fit import fit_combined
from crosscue.fusion.fit.message_fit import fit_messages
from crosscue.fusion.fit.temporal_fit import AnnotatedDrive, TemporalFit, filtered, fit_temporal
from crosscue.replay.columns import Floats
from crosscue.replay.errors import RunError
from crosscue.replay.progress import Progress, emit
from crosscue.replay.vehicle.cue_table import groups
from crosscue.replay.vehicle.vehicle import Vehicle
from crosscue.replay.versions import versions
from crosscue.results import HIDDEN
from crosscue.verb import Option

from .score import (
    THRESHOLD,
    DriveBelief,
    Flags,
    LayoutDifference,
    LayoutScore,
    LayoutScores,
    score_difference,
    score_layouts,
)
from .settings import LayoutStudy, Perception

TITLE: Final = "Random layouts, simulated: fitted on some, tested on the others"
FIGURE: Final = "trade_off.png"
SCORES: Final = ("Brier", "log score", "false a drive", "full", "full, m")
DIFFERENCES: Final = ("left out or compared", "Brier", "by it", "log score", "false a drive")

# Kinds of beliefs that are compared. The fourth is the third with the training layouts' frequencies
# as priors, which ``temporal`` also learns.
KINDS: Final = (
    "source",
    "persistent",
    "calibrated",
    "calibrated, base rates",
    "temporal",
    "combined",
)
# The belief over time, also outside approaches, where the other kinds have no belief.
EVERYWHERE: Final = "temporal, every picture"
# The rules for real roads, by section of the vehicle file.
REAL_ROADS: Final = {"regions": "area", "cars": "tracks", "fusion": "persistent"}
# Section of each rule, and its kind without the rule.
RULES: Final[dict[str, dict[str, str]]] = {
    "accumulated road": {"regions": "picture"},
    "motion-compensated trackers": {"cars": "pairs"},
    "persistence": {"fusion": "source"},
}


class _Perceived(NamedTuple):
    """Source of the pictures, detectors, and what the page says of them."""

    imager: Imager
    detectors: str
    note: str


PERCEPTION: Final[Mapping[Perception, _Perceived]] = {
    "pixels": _Perceived(
        *SPARSE_AND_EMBEDDED,
        "Everything here is simulated. The embedded networks saw rendered photographs; they were "
        "trained on other layouts of the same renderer. Intervals are 95 %, over layouts.",
    ),
    "faults": _Perceived(
        LABEL_IMAGES,
        DETECTORS,
        "Everything here is simulated. No network saw a picture: masks are the renderer's, with "
        "misses, false detections and errors of height drawn from settings that are not measured. "
        "Intervals are 95 %, over layouts.",
    ),
}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LayoutResult(StudyResult):
    """Scores of beliefs on layouts that they were not fitted to; its repr is tables.

    Attributes:
        scores: Scores of each belief, and of its ablations of cues and rules.
        drives: Outcome of each drive.
    """

    scores: LayoutScores = field(metadata=HIDDEN)
    drives: tuple[JobOutcome[Outcome], ...] = field(metadata=HIDDEN)

    @property
    def exit_status(self) -> int:
        """0 if all drives are complete; 3 if a drive failed or something was dropped."""
        return exit_status_of(self.drives)


def run_layout_study(
    study: LayoutStudy,
    output: Path | str,
    *,
    workers: int = 1,
    ablation: Annotated[bool, Option("--no-ablation")] = True,
) -> LayoutResult:
    """Fit beliefs to random simulated layouts, and test them on other layouts.

    There are thirteen kinds of layouts, five of them without an intersection. Every drive is
    rendered and processed by the embedded networks, and each belief is scored on layouts that it
    was not fitted to. With --perception faults, no network runs: the renderer's masks are used,
    with simulated faults. Writes study.html and study.json. A second start processes only the
    missing drives.

    Example:
        crosscue study layouts -o layouts --workers 2

    Args:
        study: Settings of the study.
        output: Folder for drives, runs, tables and page.
        workers: Number of drives in parallel.
        ablation: Skip the ablation of cues and rules.

    Raises:
        UsageError: ``workers`` is below 1.
        RunError: All drives of a fold failed.
        OutputError: A file cannot be written.
    """
    folder, perceived = Path(output), PERCEPTION[study.perception]
    scenes, engine = study.scenes(), engine_of(workers, None)
    done = run_drives(folder, scenes, perceived.detectors, engine, imager=perceived.imager)
    failures = {one.job.name: one.error for one in done if one.error is not None}
    drives = [open_study_drive(folder, study, one) for one in scenes if one.name not in failures]
    if len({one.fold for one in drives}) < study.folds:
        first = next(iter(failures.items()))
        raise RunError(f"{folder}: all drives of a fold failed; the first: {': '.join(first)}")
    scores = score_layout_study(drives, ablation=ablation)
    written = write_layout_study(folder, study, scores, failures)
    return LayoutResult(folder, written.tables, written.notes, scores, done)


def write_layout_study(
    folder: Path, study: LayoutStudy, scores: LayoutScores, failures: Mapping[str, str]
) -> Written:
    """Write figure, page and tables to ``folder``.

    Raises:
        OutputError: A file cannot be written.
    """
    flags = (
        f"--perception {study.perception} --blocks {study.blocks} --runs {study.runs} "
        f"--folds {study.folds} --seed {study.seed} --layouts-from {study.layouts_from} "
        f"--width {study.width_px}"
    )
    content = {
        "is_simulated": True,
        "perception": study.perception,
        "command": f"crosscue study layouts {flags}",
        "versions": versions(),
        "failures": dict(failures),
        **without_nan(asdict(scores)),
    }
    notes = [
        PERCEPTION[study.perception].note,
        f"{scores.drives} drives over {scores.layouts} layouts in {study.folds} folds.",
        *(f"failed {name}: {why}" for name, why in failures.items()),
    ]
    draw_trade_off(scores.kinds, folder / FIGURE)
    written = Written(TITLE, notes, study_tables(scores), content, [folder / FIGURE])
    written.write(folder, "study.json")
    return written


def study_tables(scores: LayoutScores) -> list[PageTable]:
    """Return all tables, for the page and for a terminal."""
    kinds, first = scores.kinds, next(iter(scores.kinds.values()))
    found = [
        _scored("Beliefs", "belief", kinds),
        PageTable(
            "Fully detected, by false features a drive; each belief with its own threshold",
            ("belief", *(f"{one.wanted:g}" for one in first.trade)),
            tuple(
                (kind, *(f"{text(p.full, 2)} at {p.threshold:.4g}" for p in one.trade))
                for kind, one in kinds.items()
            ),
        ),
        PageTable(
            "Brier score by feature",
            ("belief", *first.brier_by_feature),
            tuple((kind, *map(text, one.brier_by_feature.values())) for kind, one in kinds.items()),
        ),
        _compared("Belief over time less others", scores.less),
        PageTable(
            "Law and coverage, fractions of pictures",
            ("belief", "a way before the intersection", "no approach open"),
            tuple(
                (kind, text(one.full_before_detected), text(one.silent))
                for kind, one in kinds.items()
            ),
        ),
        _compared(
            "Each cue left out of the belief over time in every picture, without less with",
            scores.cues,
        ),
        _scored("Rules for real roads, each left out", "left out", scores.rules),
        _compared("Rules for real roads, without less with", scores.rules_less),
    ]
    return [table for table in found if table.rows]


def _scored(heading: str, what: str, some: Mapping[str, LayoutScore]) -> PageTable:
    rows = [
        (
            name or "none",
            *map(text, (one.brier, one.log_score, one.false_features, one.full)),
            text(one.full_m, 1),
        )
        for name, one in some.items()
    ]
    return PageTable(heading, (what, *SCORES), tuple(rows))


def _compared(heading: str, some: Mapping[str, LayoutDifference]) -> PageTable:
    rows = [
        (
            name,
            text(one.brier, signed=True),
            verdict(one.brier),
            *(text(value, signed=True) for value in (one.log_score, one.false_features)),
        )
        for name, one in some.items()
    ]
    return PageTable(heading, DIFFERENCES, tuple(rows))


def verdict(less: Mean) -> str:
    """Return the verdict of a difference: undecided if its interval contains zero or is missing."""
    return "better" if less.high < 0.0 else "worse" if less.low > 0.0 else "undecided"


def text(value: Mean, digits: int = 3, *, signed: bool = False) -> str:
    """Return a mean with its interval as text."""
    if math.isnan(value.value):
        return "-"
    shown = f"{'+' if signed else ''}.{digits}f"
    return f"{value.value:{shown}} ({between(value.low, value.high, shown)})"


def draw_trade_off(kinds: Mapping[str, LayoutScore], path: Path) -> None:
    """Draw full detection of each belief at the same rates of false features, with intervals.

    Raises:
        OutputError: The file cannot be written.
    """
    made, axes = bare_figure((6.4, 4.0))
    for number, (kind, score) in enumerate(kinds.items()):
        full = [one.full for one in score.trade]
        axes.errorbar(
            [one.wanted + 0.002 * number for one in score.trade],
            [one.value for one in full],
            yerr=[
                [max(one.value - one.low, 0.0) for one in full],
                [max(one.high - one.value, 0.0) for one in full],
            ],
            label=kind,
            lw=1.0,
            elinewidth=0.4,
            marker="o",
            ms=3,
        )
    axes.set_xlabel("false features a drive, at most (simulated)", fontsize=8)
    axes.set_ylabel("fraction fully detected", fontsize=8)
    axes.set_ylim(-0.02, 1.02)
    axes.tick_params(labelsize=7)
    axes.legend(fontsize=7)
    save_png(made, path)


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
        """Return the run's settings with changes by section, as a vehicle file with them has."""
        vehicle = self.run.drive_manifest().settings
        changed = {
            name: getattr(vehicle, name).model_copy(update=dict(values))
            for name, values in changes.items()
        }
        return Vehicle.model_validate(vehicle.model_copy(update=changed).model_dump())

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

    def without(cues: frozenset[str]) -> list[DriveBelief]:
        return [_everywhere(one, learned[one.fold].temporal, cues) for one in drives]

    kinds = {kind: of_kind(kind) for kind in KINDS} | {EVERYWHERE: without(frozenset())}
    every = kinds[EVERYWHERE]
    left_out = _counted("leaving out cues", "cues", list(groups().items()) if ablation else ())
    rules = {rule: with_rules(rule) for rule in (("", *RULES) if ablation else ())}
    return LayoutScores(
        {kind: score_layouts(some) for kind, some in kinds.items()},
        {
            f"{name} less {kind}": score_difference(kinds[kind], kinds[name])
            for name in ("temporal", "combined", EVERYWHERE)
            for kind in KINDS
            if kind != name
        },
        {
            group: score_difference(every, without(frozenset(cue.name for cue in some)))
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
    parts = [part for one in drives for part in one.parts]
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
        "combined": {
            "kind": "combined",
            "temporal": fitted.temporal,
            "combined": fit_combined(parts, graph),
        },
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
