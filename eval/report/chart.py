"""A chart of dots and lines, stated as values and drawn as SVG."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Final

import numpy as np
from markupsafe import Markup

from crosscue.replay.columns import Floats

from .svg_plot import Panel, SvgChart, equal_scales, thinned

WIDTH: Final = 520.0
HEIGHT: Final = 220.0
MAX_MAP: Final = 460.0
# Styles of the series, in their order.
COLOURS: Final = ("s4", "found", "s3", "s0", "s1", "s2")
LEGEND_ROW: Final = 14.0


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """One line, or dots.

    Attributes:
        name: Name in the legend.
        x: Shape (N,).
        y: Shape (N,); NaN interrupts a line.
        is_line: False for dots.
        is_truth: True for what is known, which has the colour of the truth on every page.
    """

    name: str
    x: Floats | Sequence[float]
    y: Floats | Sequence[float]
    _: KW_ONLY
    is_line: bool = True
    is_truth: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """What a chart shows.

    Attributes:
        title: What is shown; the caption.
        x_label: Label of the horizontal axis, with its unit.
        y_label: Label of the vertical axis.
        series: What is drawn, the last on top.
        is_map: True for equal scales of both axes.
    """

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    is_map: bool = False

    @property
    def is_empty(self) -> bool:
        """True if there is nothing to draw."""
        return not self._points().size

    def _points(self) -> Floats:
        """Return all finite points, shape (2, N)."""
        columns = [np.array([one.x, one.y], np.float64).reshape(2, -1) for one in self.series]
        points = np.concatenate([np.empty((2, 0)), *columns], axis=1)
        return points[:, np.isfinite(points).all(axis=0)]

    def svg(self) -> Markup:
        """Draw the chart, with a row of the legend for each series."""
        points = self._points()
        low, high = points.min(axis=1), points.max(axis=1)
        margin = np.where(high > low, 0.05 * (high - low), 0.5)
        x_range, y_range = zip((low - margin).tolist(), (high + margin).tolist(), strict=True)
        top = 34 + LEGEND_ROW * len(self.series)
        panel = Panel(60, top, WIDTH - 74, MAX_MAP if self.is_map else HEIGHT, x_range, y_range)
        if self.is_map:
            panel = equal_scales(panel)
        drawing = SvgChart(WIDTH, panel.bottom + 38, self.title, f"{self.y_label}, {self.x_label}")
        drawing.axes(panel, self.x_label, self.y_label)
        for row, one in enumerate(self.series):
            x, y = np.asarray(one.x, np.float64), np.asarray(one.y, np.float64)
            colour = "truth" if one.is_truth else COLOURS[row % len(COLOURS)]
            style = f"{'line' if one.is_line else 'fill'} {colour}"
            drawing.legend(8, 12 + LEGEND_ROW * row, [(style, one.name)])
            rows = thinned(len(x))
            if one.is_line:
                drawing.curve(panel, x[rows], y[rows], style)
                continue
            for i in rows[np.isfinite(x[rows] + y[rows])].tolist():
                drawing.dot(panel.x(x[i]), panel.y(y[i]), 2.0, f"bar {colour}")
        return drawing.svg()


def share_above(name: str, values: Floats, of: int | None = None) -> Series:
    """Return which fraction of ``of``, or of the values, is at or above each of the values."""
    ordered = np.sort(values)[::-1]
    return Series(name, ordered, np.arange(1, len(values) + 1) / max(of or len(values), 1))


def precision_and_recall(
    title: str, judged: Sequence[tuple[str, Floats, np.typing.NDArray[np.bool_], int]]
) -> Chart:
    """Return the chart of precision and recall above each score.

    Args:
        title: What is shown.
        judged: For each set of pictures its name, the scores of detections, which of them are
            right, and the number of labels.
    """
    series = []
    for name, scores, is_right, labels in judged:
        order = np.argsort(-scores, kind="stable")
        precision = np.cumsum(is_right[order]) / np.arange(1, len(order) + 1)
        series.append(Series(f"precision, {name}", scores[order], precision))
        series.append(share_above(f"recall, {name}", scores[is_right], labels))
    return Chart(title, "score", "fraction", series)
