"""Charts of a scored scene for the report, after the dissertation's Fig. 29 and 31."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from crosscue.eval.runs.tables.log_time import ClockGap, broken_at
from crosscue.eval.scoring.boxes.reliability import Reliability
from crosscue.eval.scoring.intervals import Proportion
from crosscue.eval.scoring.scene.approaches import THRESHOLD, ApproachResult, Curve
from crosscue.eval.scoring.scene.belief import BeliefScore
from crosscue.eval.scoring.scene.cues import CueFrames, is_wrong
from crosscue.eval.scoring.scene.ranges import RangeJudged, RangeScore

from .html import style_of
from .svg_plot import Panel, SvgChart

WIDTH: Final = 480.0
PUBLISHED_DETECTED_M: Final = 34.4
PUBLISHED_FULL_M: Final = 16.2
# Max number of approaches drawn as lines; more are shown only as bins.
TRACES: Final = 12


AXES: Final[Mapping[str, str]] = {
    "distance": "true distance to the intersection (m)",
    "time": "time to the last frame (s)",
}


def draw_distances(results: Sequence[ApproachResult]) -> Markup:
    """Draw distances at (full) detection with a row per intersection and a dot per approach."""
    names = sorted({one.intersection for one in results})
    known = _known([v for one in results for v in (one.detected_m, one.full_m)])
    panel = Panel(66, 34, WIDTH - 82, 30.0 * len(names), (0.0, max([40.0, *known]) * 1.05), (0, 1))
    drawing = SvgChart(
        WIDTH,
        panel.bottom + 56,
        "Distance at detection",
        "True distance of the rear axle to the intersection when it was detected and when all "
        "its features were, for each approach; the numbers are in the table.",
    )
    drawing.axes(panel, "true distance to the intersection (m)", "", y_ticks=[])
    for value, style in (
        (PUBLISHED_DETECTED_M, "line s0 dash"),
        (PUBLISHED_FULL_M, "line s1 dash"),
    ):
        drawing.rule(panel.x(value), panel.top, panel.x(value), panel.bottom, style)
    for row, name in enumerate(names):
        y = panel.top + 30.0 * row + 15.0
        drawing.text(panel.left - 6, y + 4, name[:9], "tick", "end")
        mine = [one for one in results if one.intersection == name]
        for what, style, up in (("detected_m", "s0", -5.0), ("full_m", "s1", 6.0)):
            _dots(drawing, panel, y + up, [(one, getattr(one, what)) for one in mine], style)
    drawing.legend(
        10,
        14,
        [
            ("fill s0", "detected"),
            ("fill s1", "in full"),
            ("line dash", "published means, real drives"),
            ("line bad", "never"),
        ],
    )
    return drawing.svg()


def _dots(
    drawing: SvgChart,
    panel: Panel,
    y: float,
    found: Sequence[tuple[ApproachResult, float | None]],
    style: str,
) -> None:
    values = _known([value for _, value in found])
    if values:
        mean = panel.x(sum(values) / len(values))
        drawing.rule(mean, y - 6, mean, y + 6, f"line {style} thick")
    for place, (one, value) in enumerate(found):
        if value is None:
            drawing.cross(panel.left + 6 + 5 * place, y, f"line bad {style}", one.drive)
        elif math.isfinite(value):
            drawing.dot(panel.x(value), y, 3.5, f"fill {style}", f"{one.drive}: {value:.1f} m")


def _known(values: Sequence[float | None]) -> list[float]:
    return [value for value in values if value is not None and math.isfinite(value)]


def draw_belief(
    curve: Curve,
    cues: Sequence[CueFrames],
    threshold: float = THRESHOLD,
    gaps: Sequence[ClockGap] = (),
) -> Markup:
    """Draw probability against true distance over one approach, with the cues found.

    The horizontal axis is time if the true distance is unknown.

    Args:
        curve: Belief over the approach.
        cues: Cues of the same drive.
        threshold: Probability above which a feature counts as detected.
        gaps: Gaps of the drive, which are shaded.
    """
    curve, cues, kind = _placed(curve, cues)
    label = AXES[kind]
    shown = [
        (one, found)
        for one in cues
        for found in [(one.count > 0) & (one.approach == curve.approach)]
        if found.any()
    ]
    seen_m = [one.distance_m[found] for one, found in shown]
    far = max([1.0, *_known(np.concatenate([curve.distance_m, *seen_m]).tolist())])
    panel = Panel(112, 30, WIDTH - 96, 170, (far, 0.0), (0.0, 1.0))
    lanes = Panel(112, panel.bottom + 38, WIDTH - 96, 14.0 * len(shown), panel.x_range, (0, 1))
    drawing = SvgChart(
        WIDTH + 24,
        lanes.bottom + 8,
        f"Probability against {kind}: {curve.intersection}",
        f"Probability of each feature over {label}, and below it where each cue was found: "
        + "; ".join(_report_text(name, curve, threshold, label[-2]) for name in curve.features),
    )
    drawing.axes(panel, label, "", y_ticks=[0.0, 0.25, 0.5, 0.75, 1.0])
    drawing.rule(panel.left, panel.y(threshold), panel.right, panel.y(threshold), "line dash")
    t_ns, distance_m = _way(curve, cues)
    shade_gaps(drawing, panel, gaps, t_ns, np.minimum(distance_m, far))
    rows = broken_at(gaps, curve.t_ns)
    distance_m = np.insert(curve.distance_m, rows, np.nan)
    for name, values in curve.features.items():
        drawing.curve(panel, distance_m, np.insert(values, rows, np.nan), f"line {style_of(name)}")
    drawing.legend(10, 14, [(f"line {style_of(name)}", name) for name in curve.features])
    for lane, (one, found) in enumerate(shown):
        _lane(drawing, lanes, lanes.top + 14.0 * lane, one, found, gaps)
    return drawing.svg()


def _placed(curve: Curve, cues: Sequence[CueFrames]) -> tuple[Curve, Sequence[CueFrames], str]:
    """Return the inputs with seconds to the last frame if distances are unknown, and the axis."""
    if np.isfinite(curve.distance_m).any() or not len(curve.t_ns):
        return curve, cues, "distance"
    mine = [one.t_ns[one.approach == curve.approach] for one in cues]
    last_ns = np.concatenate([curve.t_ns, *mine]).max()
    timed = [replace(one, distance_m=(last_ns - one.t_ns) * 1e-9) for one in cues]
    to_last_s = (last_ns - curve.t_ns) * 1e-9
    return replace(curve, distance_m=to_last_s), timed, "time"


def _way(curve: Curve, cues: Sequence[CueFrames]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the sorted times of an approach and the remaining distances, shape (N,) each.

    Frames before the first step of the belief are included.
    """
    mine = [(one, one.approach == curve.approach) for one in cues]
    times = np.concatenate([curve.t_ns, *(one.t_ns[rows] for one, rows in mine)])
    distance_m = np.concatenate([curve.distance_m, *(one.distance_m[rows] for one, rows in mine)])
    t_ns, first = np.unique(times, return_index=True)
    known = np.isfinite(distance_m[first])
    return t_ns[known], distance_m[first][known]


def shade_gaps(
    drawing: SvgChart,
    panel: Panel,
    gaps: Sequence[ClockGap],
    t_ns: NDArray[np.int64],
    x: NDArray[np.float64],
) -> None:
    """Shade the gaps between two rows, at their values of x, and label them with their lengths."""
    for gap in gaps:
        for row in broken_at([gap], t_ns):
            left, right = sorted(panel.x(value) for value in x[row - 1 : row + 1].tolist())
            drawing.rect(left, panel.top, max(right - left, 2.0), panel.height, "gap")
            drawing.text((left + right) / 2.0, panel.top + 11, gap.text, "halo")


def _report_text(name: str, curve: Curve, threshold: float, unit: str) -> str:
    above = np.flatnonzero(curve.features[name] > threshold)
    if not len(above):
        return f"{name} stays below {threshold:g}"
    return f"{name} exceeds {threshold:g} from {curve.distance_m[above[0]]:.0f} {unit} on"


def _lane(
    drawing: SvgChart,
    panel: Panel,
    y: float,
    cue: CueFrames,
    found: NDArray[np.bool_],
    gaps: Sequence[ClockGap],
) -> None:
    """Draw a bar for each span in which the cue was found in successive observations."""
    side = next((s for s in ("left", "right", "straight") if cue.cue.endswith(s)), "intersection")
    side = "straight" if cue.cue.endswith("past") else side
    drawing.rule(panel.left, y + 7, panel.right, y + 7, "grid")
    for rows, style in (
        (found & ~is_wrong(cue), f"bar {style_of(side)}"),
        (found & is_wrong(cue), "bar wrong"),
    ):
        places = np.flatnonzero(rows)
        leaps = np.flatnonzero(np.diff(places) > 1) + 1
        for part in np.split(places, np.union1d(leaps, broken_at(gaps, cue.t_ns[places]))):
            across = [panel.x(d) for d in _known(cue.distance_m[part].tolist())]
            if across:
                drawing.rect(min(across) - 1, y + 2, max(across) - min(across) + 3, 10, style)
    drawing.text(panel.left - 6, y + 11, cue.cue.replace("_", " "), "tick", "end")


# Max width of a distance bin, which bounds the distance of its middle from its rows.
WIDEST_BIN_M: Final = 20.0


def draw_range(
    judged: Sequence[RangeJudged],
    scores: Mapping[str, RangeScore],
    gaps: Mapping[str, Sequence[ClockGap]],
) -> Markup:
    """Draw range errors over true distance, and the consistency of the estimated variances.

    The upper panel has a line for each approach, or bias and rms error by bin if there are many.
    The lower panel has the mean NEES by bin: 1 is consistent, more is overconfident. ``gaps`` of
    each drive, by name, are shaded if there is a line for each approach.
    """
    rows = [one for one in judged if len(one.true_m)]
    few = sum(len(np.unique(one.approach)) for one in rows) <= TRACES
    errors = np.concatenate([np.abs(one.error_m) for one in rows])
    limit_m = max(1.0, float(np.percentile(errors, 99.0)) * 1.15)
    far = max(10.0, max(float(one.true_m.max()) for one in rows))
    nearest = min(float(one.true_m.min()) for one in rows)
    near = min(0.0, nearest) if nearest < WIDEST_BIN_M else nearest - WIDEST_BIN_M / 2.0
    if few:
        # A band that fills the panel does not show its width.
        two_sd = np.concatenate([2.0 * np.sqrt(one.var_m2) for one in rows])
        limit_m = max(limit_m, float(np.percentile(two_sd, 90.0)) * 1.15)
    above = Panel(40, 46, WIDTH - 50, 130, (far, near), (-limit_m, limit_m))
    below = Panel(40, above.bottom + 62, WIDTH - 50, 80, (far, near), (0.0, _max_nees(scores)))
    drawing = SvgChart(
        WIDTH,
        below.bottom + 38,
        "Range errors and their consistency",
        "; ".join(
            f"range to {name}: bias {one.bias_m.value:.2f} m, rms error {one.rmse_m:.2f} m, mean "
            f"NEES {one.nees.mean:.2f}"
            for name, one in scores.items()
        ),
    )
    drawing.axes(above, "true range (m)", "estimate less truth (m)")
    for one in rows:
        style = one.reference
        if few:
            _traces(drawing, above, one, style, gaps.get(one.drive, ()))
        else:
            _bins(drawing, above, scores[one.reference], style)
    drawing.axes(below, "true range (m)", "mean NEES, 1 is consistent")
    drawing.rule(below.left, below.y(1.0), below.right, below.y(1.0), "line dash")
    for name, score in scores.items():
        for bin_, part in score.by_distance.items():
            middle = min(max(_middle(bin_), near), far)
            hint = f"{bin_} m: {part.nees:.2f}"
            drawing.dot(below.x(middle), below.y(part.nees), 4.0, f"fill {name}", hint)
    drawing.legend(
        10,
        14,
        [
            ("line start", "to the start"),
            ("line end", "to the end"),
            ("bandkey", "estimated 2 sigma" if few else "rms error"),
        ],
    )
    return drawing.svg()


def _traces(
    drawing: SvgChart, panel: Panel, one: RangeJudged, style: str, gaps: Sequence[ClockGap]
) -> None:
    low, high = panel.y_range
    for number in np.unique(one.approach).tolist():
        mine = np.flatnonzero(one.approach == number)
        if one.reference == "start":
            shade_gaps(drawing, panel, gaps, one.t_ns[mine], one.true_m[mine])
        for part in np.split(mine, broken_at(gaps, one.t_ns[mine])):
            two_sd = np.minimum(2.0 * np.sqrt(one.var_m2[part]), high)
            drawing.band(panel, one.true_m[part], -two_sd, two_sd, f"band {style}")
            error_m = np.clip(one.error_m[part], low, high)
            drawing.curve(panel, one.true_m[part], error_m, f"line {style}")


def _bins(drawing: SvgChart, panel: Panel, score: RangeScore, style: str) -> None:
    known = {_middle(name): one for name, one in score.by_distance.items()}
    places = sorted(known)
    x = np.array(places, np.float64)
    bias: NDArray[np.float64] = np.array([known[p].bias_m for p in places])
    rmse: NDArray[np.float64] = np.array([known[p].rmse_m for p in places])
    drawing.band(panel, x, -rmse, rmse, f"band {style}")
    drawing.curve(panel, x, bias, f"line {style}")


def _middle(name: str) -> float:
    """Return the middle of a bin such as ``10-20``, or the edge of ``under 0`` and ``over 120``."""
    ends = [float(end) for end in name.removeprefix("under ").removeprefix("over ").split("-")]
    return sum(ends) / len(ends)


def _max_nees(scores: Mapping[str, RangeScore]) -> float:
    found = [one.nees for score in scores.values() for one in score.by_distance.values()]
    return max(2.0, max(found, default=2.0) * 1.1)


class _Bin(NamedTuple):
    """A bin of stated probabilities, and what was observed in it."""

    stated: float
    observed: float
    low: float
    high: float
    weight: int
    hint: str


def draw_reliability(belief: Mapping[str, BeliefScore]) -> Markup:
    """Draw the frequency of features against their stated probability, with 95 % intervals."""
    series = {
        name: (
            style_of(name),
            [
                _Bin(
                    one.mean_probability,
                    one.there.value,
                    *interval(one.there),
                    one.steps,
                    f"{name}: {one.steps} steps, stated {one.mean_probability:.2f}, so in ",
                )
                for one in score.reliability
            ],
        )
        for name, score in belief.items()
    }
    return _reliability(series, "stated probability", "observed fraction", "steps")


def draw_calibration(calibration: Sequence[Reliability]) -> Markup | None:
    """Draw the fraction of correct detections against their score; None without any detection."""
    series = {
        one.label: (
            f"s{number % 5}",
            [
                _Bin(
                    each.mean_score,
                    each.fraction,
                    each.interval.low,
                    each.interval.high,
                    each.detections,
                    f"{one.label}: {each.detections} detections, score {each.mean_score:.2f}, so ",
                )
                for each in one.bins
                if each.detections
            ],
        )
        for number, one in enumerate(calibration)
        if one.detections
    }
    return _reliability(series, "score", "fraction right", "detections") if series else None


def _reliability(
    series: Mapping[str, tuple[str, Sequence[_Bin]]], stated: str, observed: str, what: str
) -> Markup:
    panel = Panel(40, 46, 300, 260, (0.0, 1.0), (0.0, 1.0))
    drawing = SvgChart(
        panel.right + 20,
        panel.bottom + 38,
        "Reliability",
        f"{observed.capitalize()} of {what} for ten bins of the {stated}; points on the diagonal "
        "are well calibrated.",
    )
    drawing.axes(panel, stated, observed)
    drawing.rule(panel.x(0), panel.y(0), panel.x(1), panel.y(1), "line dash")
    most = max((one.weight for _, bins in series.values() for one in bins), default=1)
    for place, (style, bins) in enumerate(series.values()):
        for one in bins:
            # Slightly offset, so that series do not hide each other.
            x = panel.x(one.stated) + 3.0 * (place - 0.5 * (len(series) - 1))
            drawing.rule(x, panel.y(one.low), x, panel.y(one.high), f"line {style}")
            radius = 2.0 + 4.0 * math.sqrt(one.weight / most)
            hint = f"{one.hint}{one.observed:.2f}"
            drawing.dot(x, panel.y(one.observed), radius, f"fill {style}", hint)
    drawing.legend(8, 14, [(f"fill {style}", name) for name, (style, _) in series.items()])
    return drawing.svg()


def interval(found: Proportion) -> tuple[float, float]:
    """Return the wider of both intervals of a fraction."""
    if math.isnan(found.clusters_low):
        return found.low, found.high
    return min(found.low, found.clusters_low), max(found.high, found.clusters_high)
