"""Report of a history: charts of metrics over versions in one file without network or scripts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from markupsafe import Markup

from .html import write_page
from .svg_plot import Panel, SvgChart, ticks

TEMPLATE: Final = "history.html.j2"
WIDTH: Final = 460.0
HEIGHT: Final = 190.0
# Width of a version's name below a chart.
LABEL_PX: Final = 52.0


@dataclass(frozen=True, slots=True)
class ChangeMark:
    """A change point in a chart.

    Attributes:
        at: Index of the first version that differs.
        verdict: ``better`` or ``worse``.
        before: Value of the previous version.
        after: Value of the first version that differs.
        p: p value of the change.
    """

    at: int
    verdict: str
    before: float
    after: float
    p: float


@dataclass(frozen=True, slots=True)
class Chart:
    """One metric over versions.

    Attributes:
        title: Name of the metric.
        better: Good direction of the metric.
        values: Values by version; NaN where it was not scored.
        low: Lower ends of the intervals; NaN for too few drives.
        high: Upper ends of the intervals.
        drives: Numbers of drives by version.
        marks: Change points.
    """

    title: str
    better: str
    values: Sequence[float]
    low: Sequence[float]
    high: Sequence[float]
    drives: Sequence[int]
    marks: Sequence[ChangeMark]


def write_history_page(
    path: Path, versions: Sequence[str], charts: Sequence[Chart], content: Mapping[str, object]
) -> None:
    """Write the report.

    Args:
        path: The output file.
        versions: Names of the versions, in order.
        charts: Charts of metrics; those with change points are also listed in a table above.
        content: Further values by their names in the template.

    Raises:
        OutputError: The file cannot be written.
    """
    drawn = [(one, draw_chart(one, versions)) for one in charts]
    values = {**content, "versions": versions, "charts": drawn}
    write_page(path, TEMPLATE, values, {"number": _number, "short": _short})


def draw_chart(one: Chart, versions: Sequence[str]) -> Markup:
    """Draw values with intervals, and change points as vertical lines."""
    known = [v for v in (*one.values, *one.low, *one.high) if math.isfinite(v)]
    low, high = min(known, default=0.0), max(known, default=1.0)
    margin = 0.08 * (high - low) or max(abs(high) * 0.05, 0.01)
    last = max(len(versions) - 1, 1)
    panel = Panel(
        52, 14, WIDTH - 66, HEIGHT - 48, (-0.4, last + 0.4), (low - margin, high + margin)
    )
    what = ", ".join(f"{mark.verdict} from {versions[mark.at]} on" for mark in one.marks)
    drawing = SvgChart(WIDTH, HEIGHT, one.title, f"{len(versions)} versions; {what or 'no change'}")
    _draw_axis(drawing, panel, one, versions)
    for mark in one.marks:
        x = panel.x(mark.at - 0.5)
        drawing.rule(x, panel.top, x, panel.bottom, f"mark {mark.verdict}")
    for at, (value, below, above) in enumerate(zip(one.values, one.low, one.high, strict=True)):
        if not math.isfinite(value):
            continue
        x = panel.x(at)
        ends = ""
        if math.isfinite(below):
            drawing.rule(x, panel.y(below), x, panel.y(above), "ends")
            ends = f", 95 % {below:.4g} to {above:.4g}"
        hint = f"{versions[at]}: {value:.4g}{ends}; {one.drives[at]} drives"
        drawing.dot(x, panel.y(value), 3.5, "point", hint)
    return drawing.svg()


def _draw_axis(drawing: SvgChart, panel: Panel, one: Chart, versions: Sequence[str]) -> None:
    for value in ticks(*panel.y_range, 4):
        drawing.rule(panel.left, panel.y(value), panel.right, panel.y(value), "grid")
        drawing.text(panel.left - 6, panel.y(value) + 4, f"{value:g}", anchor="end")
    taken: list[float] = []
    # The most important versions are named first; names that would overlap are left out.
    wanted = [*(mark.at for mark in one.marks), 0, len(versions) - 1, *range(len(versions))]
    for at in dict.fromkeys(wanted):
        x = panel.x(at)
        if all(abs(x - other) >= LABEL_PX for other in taken):
            drawing.text(x, panel.bottom + 15, _short(versions[at]))
            taken.append(x)


def _short(text: str) -> str:
    is_hash = len(text) >= 20 and all(letter in "0123456789abcdef" for letter in text)
    return text[:7] if is_hash else text if len(text) <= 9 else text[:8] + "…"


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.4g}"
