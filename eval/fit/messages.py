"""Fit of the reliability of each cue to annotated drives, for ``fusion.kind = "calibrated"``."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from crosscue.eval.fit.annotated_runs import annotated_approaches, read_annotated
from crosscue.eval.fit.vehicle_output import Fitted, new_file, section_text
from crosscue.eval.pipeline.run import Run
from crosscue.eval.report.chart import Chart, Series
from crosscue.eval.scoring.intervals import Interval, between, mean_by_cluster, wilson
from crosscue.fusion.fit.fade_fit import FadeFit
from crosscue.fusion.fit.message_fit import MessageFit, RateFit, Side
from crosscue.fusion.fit.message_fit import fit_messages as fit_approaches
from crosscue.replay.columns import Floats
from crosscue.replay.errors import EmptyResultError
from crosscue.replay.files.whole_file import write_text
from crosscue.results import HIDDEN
from crosscue.verb import Option


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedMessages(Fitted):
    """Learned reliability of each cue.

    Attributes:
        fitted: Rates, decorrelation scales and exponents.
        used: Number of approaches of the runs, by kind.
        runs: Number of runs.
    """

    fitted: MessageFit = field(metadata=HIDDEN)
    used: Counter[str]
    runs: int = field(metadata=HIDDEN)

    also: ClassVar = {
        "approaches": "fitted.approaches",
        "calibrated": "calibrated",
        "rates": "rates",
        "fades": "fades",
    }

    @property
    def toml(self) -> str:
        """The vehicle file's section ``[fusion.calibrated]``, with counts as comments."""
        learned = self.fitted.calibrated
        return section_text(
            "fusion.calibrated",
            {
                "rates": [one.model_dump() for one in learned.rates],
                "exponents": learned.exponents,
                "fades": {name: fade.model_dump() for name, fade in learned.fades.items()},
            },
            {
                "rates": [
                    f"{one.there.places} and {one.missing.places} places"
                    for one in self.fitted.rates
                    if one.rates is not None
                ],
                "fades": [
                    f"{one.positives} positive of {one.observations} frames"
                    for one in self.fitted.fades
                    if one.is_learned
                ],
            },
        )

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

    def report(self) -> Iterator[str]:
        """Yield the rates, scales and exponents."""
        yield _report_text(self.fitted, self.used, self.runs)

    def charts(self) -> Iterator[Chart]:
        """Yield what was counted and what was learned, for each cue and feature."""
        both = [one for one in self.fitted.rates if one.there.places and one.missing.places]
        counted = [[_rates_of(side).rate for side in (one.missing, one.there)] for one in both]
        learned = [(one.rates.if_not, one.rates.if_there) for one in both if one.rates is not None]
        yield Chart(
            "Fraction of frames with the cue, for each cue and feature, near and far: the further "
            "above the line, the more the cue tells",
            "fraction without the feature",
            "fraction with the feature",
            (
                Series("a cue that tells nothing", (0.0, 1.0), (0.0, 1.0)),
                Series("counted", *_points(counted).T, is_line=False),
                Series("learned", *_points(learned).T, is_line=False),
            ),
        )


def _points(pairs: Sequence[Sequence[float]]) -> Floats:
    return np.array(pairs, np.float64).reshape(-1, 2)


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
    lines += ["", f"exponents: {scales or 'none: no feature was both present and absent'}"]
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
    return (
        f"{reported.rate:.2f} ({reported.wilson.low:.2f} to {reported.wilson.high:.2f} by "
        f"{side.observations:.0f} independent frames of {side.frames}; "
        f"{between(*reported.places)} by {side.places} places)"
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
    """Mean over places, Wilson's interval of independent observations, and that over places."""

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
    path, used = new_file(output, overwrite=overwrite), Counter[str]()
    graph, approaches = read_annotated(
        runs, truth, lambda run, known, car: annotated_approaches(run, known, car, used)
    )
    if not approaches:
        raise EmptyResultError(
            "fit messages: no approach of any run matches an annotated one; use more drives"
        )
    fitted = fit_approaches(approaches, graph)
    if all(one.rates is None for one in fitted.rates):
        raise EmptyResultError(
            f"fit messages: {len(approaches)} approaches are too few to learn from, so every "
            "published message is kept; use more drives with truth"
        )
    found = FittedMessages(fitted, used, len(runs), path=path)
    if path is not None:
        write_text(path, found.toml)
    return found
