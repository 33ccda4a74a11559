"""Fit of the belief over time to annotated drives, for ``fusion.kind = "temporal"``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

from crosscue.eval.fit.annotated_runs import annotated_drives, check_arguments, graph_of_runs
from crosscue.eval.pipeline.run import Run, run_given
from crosscue.eval.scoring.truth import read_scored_truth
from crosscue.fusion.fit.temporal_fit import AnnotatedDrive, TemporalFit
from crosscue.fusion.fit.temporal_fit import fit_temporal as fit_drives
from crosscue.replay.errors import EmptyResultError
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.progress import Progress, emit
from crosscue.replay.vehicle.temporal import CueChain
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedTemporal(Result):
    """Learned Markov chains of cues along a drive.

    Attributes:
        fitted: The learned parameters and their scores.
        runs: Number of runs.
        path: File that the section was written to; None without one.
    """

    fitted: TemporalFit = field(metadata=HIDDEN)
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
        """The vehicle file's section ``[fusion.temporal]``."""
        return _section_of(self.fitted)

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
        yield f"exponent {learned.exponent:g}, lapse {learned.lapse:g}: {judged}\n"
        yield self.section if self.path is None else f"written to {self.path}"


def _section_of(fit: TemporalFit) -> str:
    """Return the vehicle file's section, with the numbers of drives and places as a comment."""
    learned = fit.temporal
    lines = [
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
    return "\n".join(lines) + "\n"


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
    overwrite: bool = False,
) -> FittedTemporal:
    """Fit the belief over time to annotated drives.

    Pass finished runs and the truth of each, in the same order, including drives without an
    intersection. The result is the section [fusion.temporal] of a vehicle file, for fusion.kind =
    "temporal". It describes how each cue changes from step to step, by distance, with and without a
    road.

    Examples:
        crosscue fit temporal runs/* --truth drives/*/truth.json -o temporal.toml

    Args:
        runs: Finished runs.
        truth: Truth of each run, in the same order.
        output: File to write the section to (default: print it).
        overwrite: Replace an existing file.

    Raises:
        UsageError: The numbers of runs and truth files differ, or runs have different cues.
        EmptyResultError: Nothing can be learned.
        OutputError: The file exists, or cannot be written.
    """
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
    except ValueError as error:
        raise EmptyResultError(
            f"fit temporal: {len(drives)} drives are too few to learn from: {error}; use more"
        ) from None
    if path is not None:
        write_text(path, _section_of(fitted))
    return FittedTemporal(fitted, len(folders), path)
