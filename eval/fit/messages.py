"""Fit of the reliability of each cue to annotated drives, for ``fusion.kind = "calibrated"``."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from crosscue.datasets.truth.truth import read_truth
from crosscue.eval.fit.annotated_runs import (
    AnnotatedRuns,
    add_approaches,
    check_arguments,
    graph_of_runs,
)
from crosscue.eval.pipeline.run import Run, run_given
from crosscue.eval.scoring.intervals import TOO_FEW, Interval, mean_by_cluster, wilson
from crosscue.fusion.fit.fade_fit import FadeFit
from crosscue.fusion.fit.message_fit import MessageFit, RateFit, Side
from crosscue.fusion.fit.message_fit import fit_messages as fit_approaches
from crosscue.replay.errors import EmptyResultError
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.progress import Progress, emit
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedMessages(Result):
    """Learned reliability of each cue.

    Attributes:
        fitted: Rates, decorrelation scales and exponents.
        used: Number of approaches of the runs, by kind.
        runs: Number of runs.
        path: File that the section was written to; None without one.
    """

    fitted: MessageFit = field(metadata=HIDDEN)
    used: Counter[str]
    runs: int = field(metadata=HIDDEN)
    path: Path | None = field(metadata=HIDDEN)

    also: ClassVar = {
        "approaches": "fitted.approaches",
        "calibrated": "calibrated",
        "rates": "rates",
        "fades": "fades",
    }

    @property
    def section(self) -> str:
        """The vehicle file's section ``[fusion.calibrated]``."""
        return _section_of(self.fitted)

    @property
    def calibrated(self) -> dict[str, Any]:
        """The section as values."""
        return self.fitted.calibrated.model_dump(mode="json")

    @property
    def rates(self) -> list[dict[str, Any]]:
        """Rate of each cue and feature with its intervals, as in JSON."""
        return [
            {
                "cue": one.cue,
                "feature": one.feature,
                "near": one.near,
                "learned": one.rates is not None,
                "there": _side_json(one.there),
                "missing": _side_json(one.missing),
            }
            for one in self.fitted.rates
        ]

    @property
    def fades(self) -> list[dict[str, Any]]:
        """Scale on which the frames of each cue become independent, as in JSON."""
        return [
            {
                "cue": one.cue,
                "positives": one.positives,
                "frames": one.observations,
                "learned": one.is_learned,
                **one.fade.model_dump(),
            }
            for one in self.fitted.fades
        ]

    def lines(self) -> Iterator[str]:
        """Yield the rates, scales and exponents, and the section."""
        yield _report_text(self.fitted, self.used, self.runs)
        yield self.section if self.path is None else f"written to {self.path}"


def _report_text(fitted: MessageFit, used: Counter[str], runs: int) -> str:
    lines = [f"{runs} runs, {fitted.approaches} annotated approaches"]
    lines += [f"  {count:5} {what}" for what, count in sorted(used.items())]
    lines += ["", "fractions of positive frames, with and without the feature (95 % intervals)"]
    lines += [_rate_text(one) for one in fitted.rates if one.rates is not None]
    lines += ["", "too few observations, so the published message is kept"]
    lines += [_unlearned_text(one) for one in fitted.rates if one.rates is None]
    lines += ["", "frames become independent over"]
    lines += [_fade_text(one) for one in fitted.fades]
    scales = ", ".join(f"{name} {value:.2f}" for name, value in fitted.calibrated.exponents.items())
    lines += ["", f"exponents: {scales or 'none: no feature was both present and absent'}", ""]
    return "\n".join(lines)


def _name_of(one: RateFit) -> str:
    return f"  {one.cue} -> {one.feature}, {'near' if one.near else 'far'}"


def _rate_text(one: RateFit) -> str:
    assert one.rates is not None
    there, missing = one.rates.if_there, one.rates.if_not
    detected = math.log(there / missing)
    not_detected = math.log((1.0 - there) / (1.0 - missing))
    return (
        f"{_name_of(one)}\n    present   {_side_text(one.there)}\n"
        f"    absent    {_side_text(one.missing)}\n"
        f"    log odds of a detection {detected:+.2f}, of no detection {not_detected:+.2f}"
    )


def _unlearned_text(one: RateFit) -> str:
    positive = sum(rate > 0.0 for rate in (*one.there.rates, *one.missing.rates))
    return (
        f"{_name_of(one)}: {one.there.places} places with it, {one.missing.places} without, "
        f"{positive} positive"
    )


def _side_text(side: Side) -> str:
    reported = _rates_of(side)
    low, high = reported.places
    by_place = TOO_FEW if math.isnan(low) else f"{low:.2f} to {high:.2f}"
    return (
        f"{reported.rate:.2f} ({reported.wilson.low:.2f} to {reported.wilson.high:.2f} by "
        f"{side.observations:.0f} independent frames of {side.frames}; {by_place} by {side.places} "
        "places)"
    )


def _fade_text(one: FadeFit) -> str:
    fade = one.fade
    scale = f"{fade.way_m:.1f} m" if fade.way_m is not None else f"{fade.time_s:.2f} s"
    why = "" if one.is_learned else ", not learned: too few positive frames, or all positive"
    return f"  {one.cue:20} {scale:>8}  {one.positives} positive of {one.observations} frames{why}"


def _side_json(side: Side) -> dict[str, object]:
    reported = _rates_of(side)
    return {
        **side._asdict(),
        "rate": reported.rate,
        "wilson": list(reported.wilson),
        "by_places": list(reported.places),
    }


class _SideRate(NamedTuple):
    """A rate and its intervals.

    Attributes:
        rate: Mean over places; NaN without places.
        wilson: Interval from the number of independent observations, rounded to an integer.
        places: Interval over places; NaN for fewer than four.
    """

    rate: float
    wilson: Interval
    places: Interval


def _rates_of(side: Side) -> _SideRate:
    """Return a side's rate with both intervals."""
    observations = round(side.observations)
    rates = np.array(side.rates)
    return _SideRate(
        float(rates.mean()) if len(rates) else math.nan,
        wilson(min(round(side.hits), observations), observations),
        mean_by_cluster(rates, np.arange(len(rates))),
    )


def _section_of(fit: MessageFit) -> str:
    """Return the vehicle file's section, with counts as comments."""
    lines = ["[fusion.calibrated]", "rates = ["]
    lines += [_rate_line(one) for one in fit.rates if one.rates is not None]
    lines += ["]", "", "[fusion.calibrated.exponents]"]
    lines += [f"{name} = {value:.3f}" for name, value in fit.calibrated.exponents.items()]
    lines += ["", "[fusion.calibrated.fades]"]
    for one in fit.fades:
        if one.is_learned:
            key, value = ("way_m", one.fade.way_m), ("time_s", one.fade.time_s)
            name, number = key if key[1] is not None else value
            lines.append(
                f"{one.cue} = {{ {name} = {number:.3g} }}  "
                f"# {one.positives} positive of {one.observations} frames"
            )
    return "\n".join(lines) + "\n"


def _rate_line(one: RateFit) -> str:
    assert one.rates is not None
    return (
        f'  {{ cue = "{one.cue}", feature = "{one.feature}", near = {str(one.near).lower()}, '
        f"if_there = {one.rates.if_there:.4g}, if_not = {one.rates.if_not:.4g} }},  "
        f"# {one.there.places} and {one.missing.places} places"
    )


def fit_messages(
    runs: Sequence[Run | Path | str],
    truth: Annotated[Sequence[Path | str], Option("--truth")],
    output: Annotated[Path | str | None, Option(metavar="TOML")] = None,
    *,
    overwrite: bool = False,
) -> FittedMessages:
    """Fit the reliability of each cue to annotated drives.

    Pass finished runs and the truth of each, in the same order. The result is the section
    [fusion.calibrated] of a vehicle file, for fusion.kind = "calibrated", with the counts behind
    each line. Frames of one approach resemble each other, so counts and intervals use the effective
    number of independent frames.

    Examples:
        crosscue fit messages runs/* --truth drives/*/truth.json -o calibrated.toml

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
    found = AnnotatedRuns([], Counter())
    for done, (folder, known) in enumerate(zip(folders, truth, strict=True), 1):
        add_approaches(folder, read_truth(Path(known)), vehicle, found)
        emit(Progress("reading", done, len(folders), "runs"))
    if not found.approaches:
        raise EmptyResultError(
            "fit messages: no approach of any run matches an annotated one; use more drives"
        )
    fitted = fit_approaches(found.approaches, graph)
    if all(one.rates is None for one in fitted.rates):
        raise EmptyResultError(
            f"fit messages: {len(found.approaches)} approaches are too few to learn from, so every "
            "published message is kept; use more drives with truth"
        )
    if path is not None:
        write_text(path, _section_of(fitted))
    return FittedMessages(fitted, found.used, len(folders), path)
