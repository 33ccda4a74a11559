"""Learn the reliability of each cue from annotated drives."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from crosscue.datasets.truth.truth import load
from crosscue.eval.fit.annotated_runs import Annotated, annotate, check_arguments, graph_of_runs
from crosscue.eval.pipeline.run import Run, run_given
from crosscue.eval.scoring.intervals import TOO_FEW, Interval, mean_by_cluster, wilson
from crosscue.fusion.fit.fade_fit import FadeFit
from crosscue.fusion.fit.message_fit import MessageFit, RateFit, Side
from crosscue.fusion.fit.message_fit import fit_messages as fit_approaches
from crosscue.replay.base import EmptyResultError, write_text


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedMessages:
    """Learned reliability of each cue.

    Attributes:
        fitted: Rates, decorrelation scales and exponents.
        used: Number of approaches of the runs, by kind.
        runs: Number of runs.
        path: File that the section was written to; None without one.
    """

    fitted: MessageFit
    used: Counter[str]
    runs: int
    path: Path | None

    @property
    def section(self) -> str:
        """The vehicle file's section ``[fusion.calibrated]``."""
        return _section_of(self.fitted)

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue fit messages``."""
        return {
            "approaches": self.fitted.approaches,
            "used": dict(self.used),
            "calibrated": self.fitted.calibrated.model_dump(mode="json"),
            "rates": [
                {
                    "cue": one.cue,
                    "feature": one.feature,
                    "near": one.near,
                    "learned": one.rates is not None,
                    "there": _side_json(one.there),
                    "missing": _side_json(one.missing),
                }
                for one in self.fitted.rates
            ],
            "fades": [
                {
                    "cue": one.cue,
                    "positives": one.positives,
                    "frames": one.observations,
                    "learned": one.is_learned,
                    **one.fade.model_dump(),
                }
                for one in self.fitted.fades
            ],
        }

    def __repr__(self) -> str:
        end = self.section if self.path is None else f"written to {self.path}"
        return f"{_report_text(self.fitted, self.used, self.runs)}\n{end}"


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
    truth: Sequence[Path | str],
    output: Path | str | None = None,
    *,
    overwrite: bool = False,
    on_runs: Callable[[int, int], None] = lambda done, of: None,
) -> FittedMessages:
    """Learn the reliability of each cue, for ``fusion.kind = "calibrated"``.

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
    path = check_arguments("fit messages", len(runs), len(truth), output, overwrite=overwrite)
    folders = [run_given(one).folder for one in runs]
    graph, vehicle = graph_of_runs(folders)
    found = Annotated([], Counter())
    for done, (folder, known) in enumerate(zip(folders, truth, strict=True), 1):
        annotate(folder, load(Path(known)), vehicle, found)
        on_runs(done, len(folders))
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
