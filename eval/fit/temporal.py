"""Fit of the beliefs over time to annotated drives: ``fusion.kind`` "combined" or "temporal"."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np

from crosscue.eval.fit.annotated_runs import annotated_drives, read_annotated
from crosscue.eval.fit.vehicle_output import Fitted, new_file, section_text
from crosscue.eval.pipeline.run import Run
from crosscue.eval.report.chart import Chart, Series
from crosscue.eval.scoring.scene.trade import Reached, TradePoint, reached, trade_off
from crosscue.fusion.factor_graph import FactorGraph
from crosscue.fusion.fit.combined_fit import combined_beliefs, fit_combined
from crosscue.fusion.fit.temporal_fit import AnnotatedDrive, TemporalFit
from crosscue.fusion.fit.temporal_fit import fit_temporal as fit_drives
from crosscue.replay.columns import Floats
from crosscue.replay.errors import EmptyResultError, UsageError
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.vehicle.fusion import Combined
from crosscue.results import HIDDEN
from crosscue.verb import Option


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedTemporal(Fitted):
    """Learned Markov chains of cues along a drive.

    Attributes:
        fitted: The learned parameters and their scores.
        combined: The learned regression beside them.
        threshold: Threshold at the wanted rate of false features; None unless wanted.
        runs: Number of runs.
    """

    fitted: TemporalFit = field(metadata=HIDDEN)
    combined: Combined
    threshold: TradePoint | None
    runs: int

    also: ClassVar = {
        "drives": "fitted.drives",
        "places": "fitted.places",
        "steps": "fitted.steps",
        "log_scores": "log_scores",
        "temporal": "temporal",
    }

    @property
    def toml(self) -> str:
        """The vehicle file's section ``[fusion]``, with those of both beliefs."""
        fit = self.fitted
        text = f"# Learned from {fit.drives} drives at {fit.places} places, {fit.steps} steps.\n"
        for name, one in (("temporal", fit.temporal), ("combined", self.combined)):
            text += section_text(f"fusion.{name}", one.model_dump(exclude_unset=True)) + "\n"
        text, fusion = text.rstrip("\n") + "\n", dict[str, object](kind="combined")
        if self.threshold is None:
            return f"{section_text('fusion', fusion)}\n{text}"
        # Rounded up, for no more false features than wanted.
        established = min(max(math.ceil(1e4 * self.threshold.threshold) / 1e4, 0.01), 0.9999)
        withdrawn = min(0.5, round(0.5 * established, 4))
        fusion |= {"established": established, "withdrawn": withdrawn}
        wanted = f"# At most {self.threshold.wanted:g} false features a drive, on held-out places."
        return f"{wanted}\n{section_text('fusion', fusion)}\n{text}"

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

    def report(self) -> Iterator[str]:
        """Yield the numbers of drives and places, and the score."""
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

    def charts(self) -> Iterator[Chart]:
        """Yield the log score of each exponent and lapse on held-out places."""
        scores = self.fitted.log_scores
        series = []
        for lapse in sorted({lapse for _, lapse in scores}):
            mine = sorted(
                (exponent, value) for (exponent, at), value in scores.items() if at == lapse
            )
            series.append(Series(f"lapse {lapse:g}", *np.array(mine, np.float64).T))
        title = "Log score on held-out places; the smallest was chosen"
        yield Chart(title, "exponent", "log score", series)


def held_out_threshold(
    drives: Sequence[AnnotatedDrive], graph: FactorGraph, rate: float
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
        fitted, combined = fit_drives(learned, graph), fit_combined(learned, graph)
        for one in drives:
            if places.index(one.place) % 2 == half:
                found.append(_reached(one, graph, combined_beliefs(one, graph, fitted, combined)))
                at.append(places.index(one.place))
    return trade_off(found, np.array(at, np.int64), (rate,))[0]


def _reached(drive: AnnotatedDrive, graph: FactorGraph, values: Floats) -> Reached:
    columns = dict(zip(graph.feature_names, values.T, strict=True))
    present = [name for name, is_there in drive.features.items() if is_there]
    absent = [name for name, is_there in drive.features.items() if not is_there]
    return reached(columns, present, absent, np.zeros(len(values), np.bool_))


def fit_temporal(
    runs: Sequence[Run | Path | str],
    truth: Annotated[Sequence[Path | str], Option("--truth")],
    output: Annotated[Path | str | None, Option(metavar="TOML")] = None,
    *,
    false_features: Annotated[float | None, Option(metavar="RATE")] = None,
    overwrite: bool = False,
) -> FittedTemporal:
    """Fit the belief over time to annotated drives.

    Pass finished runs and the truth of each, in the same order, including drives without an
    intersection. The result is the section [fusion] of a vehicle file with kind = "combined".
    [fusion.temporal] describes how each cue changes from step to step, by distance, with and
    without a road; it can be used alone, as kind = "temporal". [fusion.combined] is a regression
    over how often each cue was seen. With --false-features, [fusion] has the lowest threshold that
    keeps to this rate on held-out places.

    Examples:
        crosscue fit temporal runs/* --truth drives/*/truth.json -o temporal.toml
        crosscue fit temporal runs/* --truth drives/*/truth.json --false-features 0.1

    Args:
        runs: Finished runs.
        truth: Truth of each run, in the same order.
        output: File to write the sections to (default: print them).
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
    path = new_file(output, overwrite=overwrite)
    graph, drives = read_annotated(runs, truth, annotated_drives)
    try:
        fitted, combined = fit_drives(drives, graph), fit_combined(drives, graph)
        threshold = None
        if false_features is not None:
            threshold = held_out_threshold(drives, graph, false_features)
    except ValueError as error:
        raise EmptyResultError(
            f"fit temporal: {len(drives)} drives are too few to learn from: {error}; use more"
        ) from None
    found = FittedTemporal(fitted, combined, threshold, len(runs), path=path)
    if path is not None:
        write_text(path, found.toml)
    return found
