"""Learn how far each cue is to be believed, from annotated drives, for fusion.kind = "calibrated".

Give finished runs and the truth of each, in the same order. What is learned goes into the vehicle
file's section [fusion.calibrated]; each line carries its counts. Frames of one approach resemble
each other, so looks are counted by what they are worth as independent ones, and intervals with
them.

example:
  crosscue fit messages runs/* --truth drives/*/truth.json -o calibrated.toml
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from pathlib import Path

from crosscue.datasets.truth.truth import load
from crosscue.eval.commands.shared.options import print_json, refuse_existing
from crosscue.eval.commands.shared.progress import Done, with_progress
from crosscue.eval.fit.messages import Annotated, annotate, graph_of_runs, rates_of, section_of
from crosscue.eval.runs.folder import open_run
from crosscue.fusion.fit.fade_fit import FadeFit
from crosscue.fusion.fit.message_fit import MessageFit, RateFit, Side, fit_messages
from crosscue.replay.base import EmptyResultError, UsageError, write_text
from crosscue.replay.vehicle.fusion import Rates


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run folders")
    parser.add_argument(
        "--truth",
        nargs="+",
        required=True,
        type=Path,
        metavar="T.json",
        help="truth of each run, in the same order",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="TOML",
        help="file to write the section to (default: print it)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Learn and report."""
    if len(args.runs) != len(args.truth):
        raise UsageError(
            f"fit messages: {len(args.runs)} runs, {len(args.truth)} truth files; give one "
            "for each, in the same order"
        )
    refuse_existing(args)
    runs = [open_run(path) for path in args.runs]
    graph, vehicle = graph_of_runs(runs)
    found = Annotated([], Counter())
    done = 0

    def at() -> Done:
        return Done(done, len(runs), "runs")

    pairs = zip(runs, args.truth, strict=True)
    for folder, path in with_progress(pairs, at, args, "reading"):
        annotate(folder, load(path), vehicle, found)
        done += 1
    if not found.approaches:
        raise EmptyResultError(
            "fit messages: no approach of any run lies in an annotated one; give more"
        )
    fitted = fit_messages(found.approaches, graph)
    if all(one.rates is None for one in fitted.rates):
        raise EmptyResultError(
            f"fit messages: nothing can be learned of {len(found.approaches)} approaches, so every "
            "published message stands; give more drives and their truth"
        )
    if args.output is not None:
        write_text(args.output, section_of(fitted))
    if args.json:
        print_json(_as_json(fitted, found.used))
    elif not args.quiet:
        print(_report_text(fitted, found.used, len(runs)))
        print(section_of(fitted) if args.output is None else f"written to {args.output}")
    return 0


def _report_text(fitted: MessageFit, used: Counter[str], runs: int) -> str:
    lines = [f"{runs} runs, {fitted.approaches} approaches to learn from"]
    lines += [f"  {count:5} {what}" for what, count in sorted(used.items())]
    lines += ["", "fractions of positive frames, feature there and not there (95 % intervals)"]
    lines += [_rate_text(one, one.rates) for one in fitted.rates if one.rates is not None]
    lines += ["", "too little seen, so the published message stands"]
    lines += [_unlearned_text(one) for one in fitted.rates if one.rates is None]
    lines += ["", "frames become independent over"]
    lines += [_fade_text(one) for one in fitted.fades]
    scales = ", ".join(f"{name} {value:.2f}" for name, value in fitted.calibrated.exponents.items())
    lines += ["", f"exponents: {scales or 'none: no feature was both there and not there'}", ""]
    return "\n".join(lines)


def _name_of(one: RateFit) -> str:
    return f"  {one.cue} -> {one.feature}, {'near' if one.near else 'far'}"


def _rate_text(one: RateFit, rates: Rates) -> str:
    says = math.log(rates.if_there / rates.if_not)
    silence = math.log((1.0 - rates.if_there) / (1.0 - rates.if_not))
    return (
        f"{_name_of(one)}\n    there     {_side_text(one.there)}\n"
        f"    not there {_side_text(one.missing)}\n"
        f"    log odds of a detection {says:+.2f}, of none {silence:+.2f}"
    )


def _unlearned_text(one: RateFit) -> str:
    positive = sum(rate > 0.0 for rate in (*one.there.rates, *one.missing.rates))
    return (
        f"{_name_of(one)}: {one.there.places} places with it, {one.missing.places} without, "
        f"{positive} positive"
    )


def _side_text(side: Side) -> str:
    reported = rates_of(side)
    return (
        f"{reported.rate:.2f} ({reported.wilson.low:.2f} to {reported.wilson.high:.2f} by "
        f"{side.looks:.0f} looks in {side.frames} frames; {reported.places.low:.2f} to "
        f"{reported.places.high:.2f} by {side.places} places)"
    )


def _fade_text(one: FadeFit) -> str:
    fade = one.fade
    scale = f"{fade.way_m:.1f} m" if fade.way_m is not None else f"{fade.time_s:.2f} s"
    why = "" if one.is_learned else ", not learned: too few positive, or always so"
    return f"  {one.cue:20} {scale:>8}  {one.positives} positive of {one.looks} frames{why}"


def _as_json(fitted: MessageFit, used: Counter[str]) -> dict[str, object]:
    return {
        "approaches": fitted.approaches,
        "used": dict(used),
        "calibrated": fitted.calibrated.model_dump(mode="json"),
        "rates": [
            {
                "cue": one.cue,
                "feature": one.feature,
                "near": one.near,
                "learned": one.rates is not None,
                "there": _side_json(one.there),
                "missing": _side_json(one.missing),
            }
            for one in fitted.rates
        ],
        "fades": [
            {
                "cue": one.cue,
                "positives": one.positives,
                "frames": one.looks,
                "learned": one.is_learned,
                **one.fade.model_dump(),
            }
            for one in fitted.fades
        ],
    }


def _side_json(side: Side) -> dict[str, object]:
    reported = rates_of(side)
    return {
        **side._asdict(),
        "rate": reported.rate,
        "wilson": list(reported.wilson),
        "by_places": list(reported.places),
    }
