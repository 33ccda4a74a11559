"""Chart of the belief around a failure: probabilities over time, and the frames with cues."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.report.html import style_of
from crosscue.eval.report.svg_plot import Panel, SvgChart
from crosscue.eval.runs.tables.columns import LOG_TIME
from crosscue.replay.vehicle.fusion import NOT_FEATURES

from .record import Failure

if TYPE_CHECKING:
    import pyarrow as pa
    from markupsafe import Markup

AROUND_S: Final = 6.0
WIDTH: Final = 560.0
LANES: Final = 8
THRESHOLD: Final = 0.9
# Max gap that a line is drawn across, seconds.
BREAK_S: Final = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class ChartTables:
    """Tables of a run's belief and cues for its charts; None where missing."""

    belief: pa.Table | None
    cues: pa.Table | None


def belief_around(rows: ChartTables, failure: Failure) -> Markup | None:
    """Draw the probabilities within 6 s of a failure; return None for a run without belief."""
    if rows.belief is None:
        return None
    t_s = _seconds(rows.belief["t_ns"].to_numpy(), failure.t_ns)
    near = np.flatnonzero(np.abs(t_s) <= AROUND_S)
    if not len(near):
        return None
    lanes = _lanes(rows.cues, failure)
    panel = Panel(130, 30, WIDTH - 150, 150, (-AROUND_S, AROUND_S), (0.0, 1.0))
    drawing = SvgChart(
        WIDTH,
        panel.bottom + 44 + 15.0 * len(lanes),
        f"Belief around {failure.at_s:g} s",
        "Probability of each feature over the seconds around the failure; "
        "below, the frames in which each cue was found.",
    )
    begin, end = (
        float(np.clip(_seconds(np.array([t]), failure.t_ns)[0], -AROUND_S, AROUND_S))
        for t in (failure.start_ns, failure.end_ns)
    )
    left, right = panel.x(begin), panel.x(end)
    drawing.rect(left, panel.top, max(right - left, 1.0), panel.height, "span")
    drawing.axes(panel, "seconds from the failure", "", y_ticks=[0.0, 0.5, 1.0])
    drawing.rule(panel.left, panel.y(THRESHOLD), panel.right, panel.y(THRESHOLD), "line dash")
    names = [name for name in rows.belief.column_names if name not in (*NOT_FEATURES, *LOG_TIME)]
    breaks = np.flatnonzero(np.diff(t_s[near]) > BREAK_S) + 1
    times = np.insert(t_s[near], breaks, np.nan)
    for name in names:
        values = rows.belief[name].to_numpy(zero_copy_only=False).astype(np.float64)[near]
        style = f"line {style_of(name)}{' thick' if name == failure.what else ''}"
        drawing.curve(panel, times, np.insert(values, breaks, np.nan), style)
    drawing.rule(panel.x(0.0), panel.top, panel.x(0.0), panel.bottom, "line now")
    drawing.legend(10, 14, [(f"line {style_of(name)}", name) for name in names])
    for lane, (name, found_s) in enumerate(lanes):
        y = panel.bottom + 46 + 15.0 * lane
        drawing.text(panel.left - 6, y, name.replace("_", " "), anchor="end")
        for first_s, last_s in found_s:
            x = panel.x(first_s)
            drawing.rect(x, y - 8, max(panel.x(last_s) - x, 1.5), 8, "bar")
    return drawing.svg()


def _seconds(t_ns: NDArray[np.int64], zero_ns: int) -> NDArray[np.float64]:
    return np.asarray((t_ns - zero_ns) * 1e-9, np.float64)


def _lanes(
    cues: pa.Table | None, failure: Failure
) -> Sequence[tuple[str, list[tuple[float, float]]]]:
    """Return the time spans of the cues found around a failure, the most frequent cue first."""
    if cues is None:
        return []
    t_s = _seconds(cues["t_ns"].to_numpy(), failure.t_ns)
    near = np.flatnonzero((np.abs(t_s) <= AROUND_S) & (cues["count"].to_numpy() > 0))
    names = cues["cue"].take(near).to_pylist()
    by_cue: dict[str, list[float]] = {}
    for name, when in zip(names, t_s[near].tolist(), strict=True):
        by_cue.setdefault(name, []).append(when)
    ordered = sorted(by_cue.items(), key=lambda pair: (-len(pair[1]), pair[0]))[:LANES]
    return [(name, _spans(np.array(sorted(times)))) for name, times in ordered]


def _spans(times: NDArray[np.float64]) -> list[tuple[float, float]]:
    step = max(float(np.median(np.diff(times))) if len(times) > 2 else 0.1, 0.02)
    parts = np.split(times, np.flatnonzero(np.diff(times) > 2.5 * step) + 1)
    return [(float(part[0]), float(part[-1]) + 0.5 * step) for part in parts]
