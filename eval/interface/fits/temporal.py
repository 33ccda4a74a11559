"""Learn the belief over time from annotated drives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from crosscue.eval.fit.annotated_runs import annotated_drives, check_arguments, graph_of_runs
from crosscue.eval.pipeline.run import Run, run_given
from crosscue.eval.scoring.truth import load
from crosscue.fusion.fit.temporal_fit import AnnotatedDrive, TemporalFit
from crosscue.fusion.fit.temporal_fit import fit_temporal as fit_drives
from crosscue.replay.base import EmptyResultError, write_text
from crosscue.replay.vehicle.temporal import CueChain


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedTemporal:
    """Learned Markov chains of cues along a drive.

    Attributes:
        fitted: The learned parameters and their scores.
        runs: Number of runs.
        path: File that the section was written to; None without one.
    """

    fitted: TemporalFit
    runs: int
    path: Path | None

    @property
    def section(self) -> str:
        """The vehicle file's section ``[fusion.temporal]``."""
        return _section_of(self.fitted)

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue fit temporal``."""
        return {
            "runs": self.runs,
            "drives": self.fitted.drives,
            "places": self.fitted.places,
            "steps": self.fitted.steps,
            "log_scores": [
                {"exponent": exponent, "lapse": lapse, "log_score": value}
                for (exponent, lapse), value in self.fitted.log_scores.items()
            ],
            "temporal": self.fitted.temporal.model_dump(mode="json"),
        }

    def __repr__(self) -> str:
        end = self.section if self.path is None else f"written to {self.path}"
        learned = self.fitted.temporal
        score = self.fitted.log_scores.get((learned.exponent, learned.lapse))
        judged = (
            "too few places to score"
            if score is None
            else f"log score {score:.3f} on held-out places"
        )
        return (
            f"{self.runs} runs, {self.fitted.drives} drives at {self.fitted.places} places, "
            f"{self.fitted.steps} steps\n"
            f"exponent {learned.exponent:g}, lapse {learned.lapse:g}: {judged}\n\n{end}"
        )


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
    truth: Sequence[Path | str],
    output: Path | str | None = None,
    *,
    overwrite: bool = False,
    on_runs: Callable[[int, int], None] = lambda done, of: None,
) -> FittedTemporal:
    """Learn the belief over time, for ``fusion.kind = "temporal"``.

    Args:
        runs: Finished runs.
        truth: The truth of each, in the same order.
        output: TOML file for the section; default: it is only returned.
        overwrite: Replace an existing file.
        on_runs: Called with the number of runs read, and their total.

    Raises:
        UsageError: The numbers of runs and truth files differ, or runs have different cues.
        EmptyResultError: Nothing can be learned.
        OutputError: The file exists, or cannot be written.
    """
    path = check_arguments("fit temporal", len(runs), len(truth), output, overwrite=overwrite)
    folders = [run_given(one).folder for one in runs]
    graph, vehicle = graph_of_runs(folders)
    drives: list[AnnotatedDrive] = []
    for done, (folder, known) in enumerate(zip(folders, truth, strict=True), 1):
        drives += annotated_drives(folder, load(Path(known), str(folder.path)), vehicle)
        on_runs(done, len(folders))
    try:
        fitted = fit_drives(drives, graph)
    except ValueError as error:
        raise EmptyResultError(
            f"fit temporal: {len(drives)} drives are too few to learn from: {error}; use more"
        ) from None
    if path is not None:
        write_text(path, _section_of(fitted))
    return FittedTemporal(fitted, len(folders), path)
