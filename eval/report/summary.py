"""Text output of scores, at most 80 columns wide, coverage first."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from textwrap import wrap
from typing import Final

import numpy as np

from crosscue.eval.scoring.drives import PooledScores
from crosscue.eval.scoring.gates import GateResult
from crosscue.eval.scoring.intervals import (
    MIN_CLUSTERS,
    TOO_FEW,
    Mean,
    Proportion,
    between,
    mean,
)
from crosscue.eval.scoring.metric_values import MetricValue
from crosscue.eval.scoring.pose.score import PlaneMounting, PoseErrorSummary, PoseScore
from crosscue.eval.scoring.scene.approaches import ApproachScore
from crosscue.eval.scoring.scene.belief import BeliefScore
from crosscue.eval.scoring.scene.cues import CueScore
from crosscue.eval.scoring.scene.ranges import RangeScore
from crosscue.replay.columns import Int64s
from crosscue.replay.safe_text import counted, visible

from .scene_figures import interval

WIDTH: Final = 80
LABEL: Final = 11


def scores_text(scores: PooledScores, why_no_pose: str = "") -> str:
    """Return the pooled scores of any number of drives as text."""
    lines: list[str] = []
    if scores.approaches is not None:
        lines += [*_approaches(scores.approaches), ""]
    if scores.cues:
        lines += [*_cues(scores.cues), ""]
    if scores.range:
        lines += [*_range(scores.range), ""]
    if scores.belief:
        lines += [*_belief(scores.belief), ""]
    has_frames = any(one.frames for one in scores.drives)
    missing = scores.not_scored() if has_frames else {}
    missing |= {"pose": why_no_pose} if why_no_pose else {}
    without = f"{len(scores.drives)}, without pictures: no cue, belief or range to score"
    lines += _coverage(scores) if has_frames else [_line("drives", without)]
    lines += [_line("not scored", f"{k}: {v}") for k, v in missing.items()]
    lines += _left_out(scores.cues)
    return "\n".join(part for line in lines for part in _wrapped(line))


def reported_line(label: str, text: str) -> str:
    """Return a labelled line, wrapped if it is too long."""
    return "\n".join(_wrapped(_line(label, text)))


def gate_lines(results: Sequence[GateResult]) -> str:
    """Return one line for each gate, failures last."""
    ordered = sorted(results, key=lambda one: bool(one.failure))
    lines = [
        _line("FAILED" if one.failure else "passed", visible(one.gate.text()) + _end(one))
        for one in ordered
    ]
    return "\n".join(part for line in lines for part in _wrapped(line))


def _end(one: GateResult) -> str:
    return f": {one.failure}" if one.failure else f" ({_number(one.value)})"


def _line(label: str, text: str) -> str:
    return f"{label:{LABEL}}{text}"


def _wrapped(line: str) -> Iterator[str]:
    """Wrap a long line and indent the continuation to the column after the label."""
    while len(line) > WIDTH:
        cut = line.rfind(" ", LABEL + 1, WIDTH + 1)
        cut = cut if cut > LABEL else WIDTH
        yield line[:cut].rstrip()
        line = " " * LABEL + line[cut:].lstrip()
    yield line


def _coverage(scores: PooledScores) -> list[str]:
    frames = sum(one.frames for one in scores.drives)
    reported = sum(one.frames_annotated for one in scores.drives)
    truth_s = sum(one.truth_s for one in scores.drives)
    covered_s = sum(one.truth_covered_s for one in scores.drives)
    n = len(scores.drives)
    twice = sum(one.frames_ambiguous for one in scores.drives)
    runs = "run covers" if n == 1 else "runs cover"
    lines = [
        _line("drives", f"{n}: of {counted(frames, 'frame')} the truth covers {reported}"),
        _line("truth", f"{truth_s:.1f} s, of which the {runs} {covered_s:.1f} s"),
    ]
    if twice:
        why = "a clock was set back, and their log time comes twice"
        lines.append(_line("ambiguous", f"{counted(twice, 'frame')} not scored: {why}"))
    return lines


def _cues(cues: Mapping[str, CueScore]) -> list[str]:
    scored = {name: one for name, one in cues.items() if one.scored}
    shown = {name: one for name, one in scored.items() if one.positives or _is_missed(one)}
    lines = ["cue                  scored  found  precision (95 %)      recall (95 %)"]
    for name, one in shown.items():
        star = " " if one.is_sources_reading else "*"
        recall = "-" if one.recall is None else _fraction(one.recall)
        lines.append(
            f"{visible(name):19}{star} {one.scored:6} {one.positives:6}  "
            f"{_fraction(one.precision):20}  {recall}".rstrip()
        )
    none = [visible(name) for name in scored if name not in shown]
    if none:
        lines.append(_line("found none", f"and none is known to be missed: {', '.join(none)}"))
    if any(not one.is_sources_reading for one in shown.values()):
        lines.append("* judged by the feature or object that the source does not judge it by")
    if any(math.isnan(one.precision.clusters_low) for one in shown.values() if one.positives):
        lines.append(f"{TOO_FEW}: under {MIN_CLUSTERS}, intervals count frames only")
    return lines


def _is_missed(one: CueScore) -> bool:
    return one.recall is not None and bool(one.recall.of)


def _left_out(cues: Mapping[str, CueScore]) -> list[str]:
    """Return the reasons why frames were not scored, with cues of the same reasons merged."""
    same: dict[tuple[tuple[str, int], ...], list[str]] = {}
    for name, one in cues.items():
        reasons = one.readings[one.reading].left_out
        if reasons:
            same.setdefault(tuple(reasons.items()), []).append(visible(name))
    lines = []
    for why, names in same.items():
        reported = ", ".join(f"{count} {reason}" for reason, count in why)
        whom = "all cues" if len(names) == len(cues) else ", ".join(names)
        lines.append(_line("left out", f"{reported}: {whom}"))
    return lines


def _fraction(one: Proportion) -> str:
    if not one.of:
        return "-"
    low, high = interval(one)
    return f"{one.value:.3f} ({low:.2f} to {high:.2f})"


def _approaches(one: ApproachScore) -> list[str]:
    lines = [
        _line(
            "approaches",
            f"{one.approaches} true, found {one.matched}; extra "
            f"{one.extra} ({one.extra_detected} believed), in pieces {one.splits}",
        ),
        _line("detected", _distance(one.detected, one.detected_m)),
        _line("in full", _distance(one.full, one.full_m)),
    ]
    if one.spurious:
        lines.append(_line("spurious", _spurious(one)))
    if one.false_by_feature:
        reported = ", ".join(f"{name} {n}" for name, n in one.false_by_feature.items())
        lines.append(
            _line(
                "false",
                f"absent features believed in {one.false_features.right} of "
                f"{counted(one.false_features.of, 'approach', 'approaches')}: {reported}",
            )
        )
    for what, reasons in one.failures.items():
        for reason, count in reasons.items():
            lines.append(_line("failed", f"{what}: {count} {reason}"))
    if one.not_judged:
        lines.append(_line("not judged", f"{one.not_judged} outside the truth's time"))
    return lines


def _spurious(one: ApproachScore) -> str:
    reasons = Counter(result.why_spurious for result in one.results if result.why_spurious)
    reported = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
    detections = counted(one.spurious, "detection as published does", "detections as published do")
    return f"{detections} not count: {reported}"


def _distance(found: Proportion, distance: Mean) -> str:
    text = f"{found.right} of {found.of}"
    if not distance.of:
        return text
    ends = between(distance.low, distance.high, ".1f")
    return f"{text}, {distance.value:.1f} m away on average ({ends})"


def _belief(belief: Mapping[str, BeliefScore]) -> list[str]:
    if not any(one.scored for one in belief.values()):
        return [_line("belief", "no step that the truth could judge")]
    lines = ["belief         scored of steps   there   Brier  of base rate  log score"]
    for name, one in belief.items():
        lines.append(
            f"{visible(name):14} {one.scored:6} {one.steps:8}  {_number(one.fraction_there):>6}  "
            f"{_number(one.brier.value):>6}  {_number(one.brier_of_base_rate):>12}  "
            f"{_number(one.log_score.value):>9}"
        )
    return lines


def _range(ranges: Mapping[str, RangeScore]) -> list[str]:
    lines = ["range to       scored  of rows    bias    rmse  mean NEES  inside 95 %"]
    for name, one in ranges.items():
        inside = 100.0 * one.nees.fraction_inside_95
        lines.append(
            f"{name:14} {one.scored:6} {one.rows:8} {_number(one.bias_m.value, 2):>6}m "
            f"{_number(one.rmse_m, 2):>6}m  {_number(one.nees.mean, 2):>9}  "
            f"{_number(inside, 0):>9} %"
        )
        for control, part in one.by_control.items() if len(one.by_control) > 1 else ():
            lines.append(
                f"  {control.replace('_', ' '):12} {part.rows:6} {'':8} "
                f"{_number(part.bias_m, 2):>6}m {_number(part.rmse_m, 2):>6}m  "
                f"{_number(part.nees, 2):>9}  {_number(100.0 * part.fraction_inside_95, 0):>9} %"
            )
    return lines


def _number(value: float, digits: int = 3) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def headline(name: str, values: Mapping[str, MetricValue]) -> str:
    """Return one line for one drive of many."""
    parts = []
    for label, path in (
        ("detected", "approaches.detected_m"),
        ("in full", "approaches.full_m"),
        ("pose", "pose.ape.none.translation_m.rmse"),
    ):
        value = values[path].value if path in values else math.nan
        if not math.isnan(value):
            parts.append(f"{label} {value:.1f} m")
    return f"{visible(name)}: {', '.join(parts) or 'nothing detected'}"


def pose_summary(result: PoseScore) -> str:
    """Return the score of a pose as text, at most 80 columns wide."""
    covered = result.coverage
    left_out = [
        f"{count} {why}"
        for count, why in (
            (covered.before_estimate, "before the first estimate"),
            (covered.after_estimate, "after the last"),
            (covered.in_gap, "in a gap of the estimate"),
            (covered.ambiguous, "whose log time comes twice"),
        )
        if count
    ]
    lines = [
        f"truth      {covered.scored} of {covered.truth_poses} poses scored over "
        f"{result.distance_m:.0f} m" + (f"; not: {', '.join(left_out)}" if left_out else ""),
        *_compared_lines(result.compared_at),
        "",
        "error                       rmse     mean   median      max     rotation rmse",
    ]
    lines += [_pose_row(f"APE, aligned: {how}", errors) for how, errors in result.ape.items()]
    lines += [_pose_row(f"RPE over {size}", errors) for size, errors in result.rpe.items()]
    lines += ["", *_nees_lines(result)]
    lost = "never lost" if result.lost_at_m is None else f"lost after {result.lost_at_m:.0f} m"
    lines.append(f"2-sigma ellipse at the end: {result.major_axis_m:.1f} m long; {lost}")
    return "\n".join(lines)


def poses_summary(poses: Sequence[PoseScore], places: Int64s) -> str:
    """Return the pose scores of several drives, with intervals over places; NEES if defined."""
    lost = sum(one.lost_at_m is not None for one in poses)
    lines = [
        _line("pose", f"{counted(len(poses), 'drive')}, {lost} lost; means over drives (95 %)")
    ]
    for name, unit, values in (
        ("APE, rms", " m", [one.ape["none"].translation_m.rmse for one in poses]),
        ("NEES of x, y", ", 2 is consistent", [one.nees_xy.mean for one in poses]),
        ("NEES of x, y, heading", ", 3 is consistent", [one.nees_xyh.mean for one in poses]),
    ):
        found = mean(np.array(values), places)
        if found.of:
            ends = between(found.low, found.high)
            lines.append(_line("", f"{name:22} {found.value:.2f} ({ends}){unit}"))
    return "\n".join(lines)


def _compared_lines(at: PlaneMounting) -> list[str]:
    """Return lines on the body whose pose is compared, its mounting, and the mounting's source."""
    body = at.body.replace("_", " ")
    if at.body != "rear_axle" or at.x_m or at.y_m or at.yaw_rad:
        place = f"{at.x_m:.2f} m ahead and {at.y_m:.2f} m left of the rear axle"
        body += f", {place}, turned {math.degrees(at.yaw_rad):.2f} deg left"
    lines = [f"compared at the {body}"]
    if at.assumed:
        names = ", ".join(at.assumed)
        lines.append(f"           {names}: unknown to the truth; as the vehicle file has it")
    if at.source:
        lines += wrap(at.source, 80, initial_indent=" " * 11, subsequent_indent=" " * 11)
    return lines


def _pose_row(name: str, errors: PoseErrorSummary) -> str:
    t = errors.translation_m
    numbers = " ".join(f"{value:8.3f}" for value in (t.rmse, t.mean, t.median, t.max))
    return f"{name:22} {numbers} m {errors.rotation_deg.rmse:9.3f} deg"


def _nees_lines(result: PoseScore) -> list[str]:
    lines = [f"NEES not computed: {result.why_no_nees}"] if result.why_no_nees else []
    for name, n in (("x, y", result.nees_xy), ("x, y, heading", result.nees_xyh)):
        if math.isnan(n.mean):
            continue
        lines.append(
            f"NEES of {name}: mean {n.mean:.2f} (consistent for one drive: {n.band_low:.2f} to "
            f"{n.band_high:.2f}), {100 * n.fraction_inside_95:.0f} % inside 95 %"
        )
    return lines
