"""Fit of the belief over time to annotated drives, for ``fusion.kind = "temporal"``."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np

from crosscue.eval.fit.annotated_runs import annotated_drives, check_arguments, graph_of_runs
from crosscue.eval.pipeline.run import Run, run_given
from crosscue.eval.scoring.scene.trade import Reached, TradePoint, reached, trade_off
from crosscue.eval.scoring.truth import read_scored_truth
from crosscue.fusion.factor_graph import FactorGraph
from crosscue.fusion.fit.combined_fit import combined_beliefs, fit_combined
from crosscue.fusion.fit.temporal_fit import AnnotatedDrive, TemporalFit, filtered
from crosscue.fusion.fit.temporal_fit import fit_temporal as fit_drives
from crosscue.replay.errors import EmptyResultError, UsageError
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.progress import Progress, emit
from crosscue.replay.vehicle.combined import Combined
from crosscue.replay.vehicle.temporal import CueChain
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedTemporal(Result):
    """Learned Markov chains of cues along a drive.

    Attributes:
        fitted: The learned parameters and their scores.
        combined: The regression of ``fusion.kind = "combined"``; None unless wanted.
        threshold: Threshold at the wanted rate of false features; None unless wanted.
        runs: Number of runs.
        path: File that the section was written to; None without one.
    """

    fitted: TemporalFit = field(metadata=HIDDEN)
    combined: Combined | None = field(metadata=HIDDEN)
    threshold: TradePoint | None
    runs: int
    path: Path | None = field(metadata=HIDDEN)

    also: ClassVar = {
        "drives": "fitted.drives",
        "places": "fitted.places",
        "steps": "fitted.steps",
        "log_scores": "log_scores",
        "temporal": "temporal",
    }

    @property
    def section(self) -> str:
        """The vehicle file's section ``[fusion.temporal]``, and those asked for besides."""
        return _section_of(self.fitted, self.combined, self.threshold)

    @property
    def temporal(self) -> dict[str, Any]:
        """The section as values."""
        return self.fitted.temporal.model_dump(mode="json")

    @property
    def log_scores(self) -> list[dict[str, float]]:
        """Score of each exponent and lapse on held-out places, as in JSON."""
        return [
            {"exponent": exponent, "lapse": lapse, "log_score": value}
            for (exponent, lapse), value in self.fitted.log_scores.items()
        ]

    def lines(self) -> Iterator[str]:
        """Yield the numbers of drives and places, the score, and the section."""
        fitted, learned = self.fitted, self.fitted.temporal
        score = fitted.log_scores.get((learned.exponent, learned.lapse))
        judged = (
            "too few places to score"
            if score is None
            else f"log score {score:.3f} on held-out places"
        )
        yield (
            f"{self.runs} runs, {fitted.drives} drives at {fitted.places} places, "
            f"{fitted.steps} steps"
        )
        yield f"exponent {learned.exponent:g}, lapse {learned.lapse:g}: {judged}"
        if self.threshold is not None:
            one = self.threshold
            yield (
                f"threshold {one.threshold:.4g}: {one.false_features:.2f} false features a drive, "
                f"{100.0 * one.full.value:.0f} % fully detected, on held-out places"
            )
        yield ""
        yield self.section if self.path is None else f"written to {self.path}"


def _section_of(fit: TemporalFit, combined: Combined | None, threshold: TradePoint | None) -> str:
    """Return the vehicle file's sections, with the numbers of drives and places as a comment."""
    learned, lines = fit.temporal, []
    if threshold is not None:
        # Rounded up, for no more false features than wanted.
        established = min(max(math.ceil(1e4 * threshold.threshold) / 1e4, 0.01), 0.9999)
        lines = [
            f"# At most {threshold.wanted:g} false features a drive, on held-out places.",
            "[fusion]",
            f'kind = "{"temporal" if combined is None else "combined"}"',
            f"established = {established}",
            f"withdrawn = {min(0.5, round(0.5 * established, 4))}",
            "",
        ]
    lines += [
        f"# Learned from {fit.drives} drives at {fit.places} places, {fit.steps} steps.",
        "[fusion.temporal]",
        f"ahead = {learned.ahead:.4f}",
        f"edges_m = {list(learned.edges_m)}",
        f"exponent = {learned.exponent}",
        f"lapse = {learned.lapse}",
        f"stray = {learned.stray}",
        "chains = [",
        *(f"  {_chain_line(one)}," for one in learned.chains),
        "]",
        "",
        "[fusion.temporal.ways]",
        *(f'"{name}" = {fraction}' for name, fraction in learned.ways.items()),
    ]
    if combined is not None:
        lines += ["", "[fusion.combined]", f"fade_m = {combined.fade_m}"]
        lines += ["", "[fusion.combined.intercepts]"]
        lines += [f"{name} = {value}" for name, value in combined.intercepts.items()]
        for name, weights in combined.weights.items():
            lines += ["", f"[fusion.combined.weights.{name}]"]
            lines += [f"{other} = {value}" for other, value in weights.items()]
    return "\n".join(lines) + "\n"


def held_out_threshold(
    drives: Sequence[AnnotatedDrive], graph: FactorGraph, rate: float, *, is_combined: bool
) -> TradePoint:
    """Return the threshold with a rate of false features a drive, of beliefs fitted elsewhere.

    The drives of each half of the places are believed with what was learned at the other half.

    Raises:
        ValueError: A half is too small to learn from.
    """
    places = sorted({one.place for one in drives})
    found: list[Reached] = []
    at: list[int] = []
    for half in (0, 1):
        learned = [one for one in drives if places.index(one.place) % 2 != half]
        fitted = fit_drives(learned, graph)
        combined = fit_combined(learned, graph, fitted) if is_combined else None
        for one in drives:
            if places.index(one.place) % 2 == half:
                found.append(_reached(one, graph, fitted, combined))
                at.append(places.index(one.place))
    return trade_off(found, np.array(at, np.int64), (rate,))[0]


def _reached(
    drive: AnnotatedDrive, graph: FactorGraph, fitted: TemporalFit, combined: Combined | None
) -> Reached:
    if combined is None:
        values = filtered(drive, fitted.model)
    else:
        values = combined_beliefs(drive, graph, fitted, combined)
    columns = dict(zip(graph.feature_names, values.T, strict=True))
    present = [name for name, is_there in drive.features.items() if is_there]
    absent = [name for name, is_there in drive.features.items() if not is_there]
    return reached(columns, present, absent, np.zeros(len(values), np.bool_))


def _chain_line(one: CueChain) -> str:
    parts = [f'cue = "{one.cue}"']
    for name in ("there", "missing"):
        if getattr(one, name):
            features = ", ".join(f'"{feature}"' for feature in getattr(one, name))
            parts.append(f"{name} = [{features}]")
    parts += [f"{name} = {list(getattr(one, name))}" for name in ("first", "stays", "appears")]
    return f"{{ {', '.join(parts)} }}"


def fit_temporal(
    runs: Sequence[Run | Path | str],
    truth: Annotated[Sequence[Path | str], Option("--truth")],
    output: Annotated[Path | str | None, Option(metavar="TOML")] = None,
    *,
    combined: bool = False,
    false_features: Annotated[float | None, Option(metavar="RATE")] = None,
    overwrite: bool = False,
) -> FittedTemporal:
    """Fit the belief over time to annotated drives.

    Pass finished runs and the truth of each, in the same order, including drives without an
    intersection. The result is the section [fusion.temporal] of a vehicle file, for fusion.kind =
    "temporal". It describes how each cue changes from step to step, by distance, with and without a
    road. With --combined, it has [fusion.combined] too, for fusion.kind = "combined". With
    --false-features, it has [fusion] with the lowest threshold that keeps to this rate on held-out
    places.

    Examples:
        crosscue fit temporal runs/* --truth drives/*/truth.json -o temporal.toml
        crosscue fit temporal runs/* --truth drives/*/truth.json --combined --false-features 0.1

    Args:
        runs: Finished runs.
        truth: Truth of each run, in the same order.
        output: File to write the section to (default: print it).
        combined: Also fit the regression of the combined belief.
        false_features: Wanted number of absent features above the threshold per drive.
        overwrite: Replace an existing file.

    Raises:
        UsageError: The rate is negative, the numbers of runs and truth files differ, or runs have
            different cues.
        EmptyResultError: Nothing can be learned.
        OutputError: The file exists, or cannot be written.
    """
    if false_features is not None and not 0.0 <= false_features < math.inf:
        raise UsageError(f"false_features: {false_features}, expected a number, 0 or more")
    path = check_arguments(len(runs), len(truth), output, overwrite=overwrite)
    folders = [run_given(one).folder for one in runs]
    graph, vehicle = graph_of_runs(folders)
    drives: list[AnnotatedDrive] = []
    for done, (folder, known) in enumerate(zip(folders, truth, strict=True), 1):
        drives += annotated_drives(
            folder, read_scored_truth(Path(known), str(folder.path)), vehicle
        )
        emit(Progress("reading", done, len(folders), "runs"))
    try:
        fitted = fit_drives(drives, graph)
        regression = fit_combined(drives, graph, fitted) if combined else None
        threshold = None
        if false_features is not None:
            threshold = held_out_threshold(drives, graph, false_features, is_combined=combined)
    except ValueError as error:
        raise EmptyResultError(
            f"fit temporal: {len(drives)} drives are too few to learn from: {error}; use more"
        ) from None
    if path is not None:
        write_text(path, _section_of(fitted, regression, threshold))
    return FittedTemporal(fitted, regression, threshold, len(folders), path)
