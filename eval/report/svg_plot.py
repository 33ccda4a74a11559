"""Small SVG charts inside a page, with colours from the page's style sheet, dark or light.

All external text is escaped here. Each chart has a title and a description for screen readers. The
same input yields the same bytes.

matplotlib draws the figures of studies but not these charts. Its SVG does not follow the style of
the page and has no tooltips. It is also twice as large (21 against 11 kB for four curves of 200
points), and slower: twelve charts take 0.5 s of CPU, plus 0.35 s for the import, against 0.01 s.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

# Max number of points of a line.
POINTS: Final = 1500


@dataclass(frozen=True, slots=True)
class Panel:
    """A rectangle of the drawing with its own axes.

    Attributes:
        left: Left edge, in the drawing's units.
        top: Top edge; y increases downward.
        width: Width of the rectangle.
        height: Height of the rectangle.
        x_range: Values at the left and right edge; the first may be the larger one.
        y_range: Values at the bottom and top edge.
    """

    left: float
    top: float
    width: float
    height: float
    x_range: tuple[float, float]
    y_range: tuple[float, float]

    def x(self, value: float) -> float:
        """Return the horizontal position of a value."""
        low, high = self.x_range
        return self.left + self.width * (value - low) / (high - low)

    def y(self, value: float) -> float:
        """Return the vertical position of a value."""
        low, high = self.y_range
        return self.top + self.height * (1.0 - (value - low) / (high - low))

    @property
    def bottom(self) -> float:
        """Lower edge."""
        return self.top + self.height

    @property
    def right(self) -> float:
        """Right edge."""
        return self.left + self.width


def equal_scales(panel: Panel) -> Panel:
    """Return a panel of the same width, at most as high, in which a metre has one length.

    The values of the shorter side are extended.
    """
    wide, tall = (abs(high - low) for low, high in (panel.x_range, panel.y_range))
    height = min(max(panel.width * tall / wide, 120.0), panel.height)
    scale = max(wide / panel.width, tall / height)
    ranges = [
        (0.5 * (low + high - scale * size), 0.5 * (low + high + scale * size))
        for (low, high), size in ((panel.x_range, panel.width), (panel.y_range, height))
    ]
    return replace(panel, height=height, x_range=ranges[0], y_range=ranges[1])


@dataclass(slots=True)
class SvgChart:
    """A chart being drawn.

    Attributes:
        width: Width, in units of about a pixel.
        height: Height, in the same units.
        title: Title in a few words.
        description: Description of the chart, for screen readers.
    """

    width: float
    height: float
    title: str
    description: str
    _parts: list[str] = field(default_factory=list)

    def svg(self) -> Markup:
        """Return the complete SVG element."""
        head = (
            f'<svg viewBox="0 0 {_n(self.width)} {_n(self.height)}" role="img" '
            f'style="max-width:{_n(self.width * 1.15)}px">'
            f"<title>{escape(self.title)}</title><desc>{escape(self.description)}</desc>"
        )
        return Markup(head + "".join(self._parts) + "</svg>")  # noqa: S704 - parts are escaped

    def text(
        self, x: float, y: float, text: str, style: str = "tick", anchor: str = "middle"
    ) -> None:
        """Draw a line of text with its baseline at y."""
        self._parts.append(
            f'<text x="{_n(x)}" y="{_n(y)}" class="{style}" text-anchor="{anchor}">'
            f"{escape(text)}</text>"
        )

    def rule(self, x0: float, y0: float, x1: float, y1: float, style: str) -> None:
        """Draw a straight line."""
        self._parts.append(
            f'<line x1="{_n(x0)}" y1="{_n(y0)}" x2="{_n(x1)}" y2="{_n(y1)}" class="{style}"/>'
        )

    def rect(self, x: float, y: float, width: float, height: float, style: str) -> None:
        """Draw a filled rectangle."""
        self._parts.append(
            f'<rect x="{_n(x)}" y="{_n(y)}" width="{_n(width)}" height="{_n(height)}" '
            f'class="{style}"/>'
        )

    def axes(
        self, panel: Panel, x_label: str, y_label: str, y_ticks: Sequence[float] | None = None
    ) -> None:
        """Draw grid, ticks and labels."""
        for value in ticks(*panel.x_range):
            self.rule(panel.x(value), panel.top, panel.x(value), panel.bottom, "grid")
            self.text(panel.x(value), panel.bottom + 13, f"{value:g}")
        for value in ticks(*panel.y_range, 5) if y_ticks is None else y_ticks:
            self.rule(panel.left, panel.y(value), panel.right, panel.y(value), "grid")
            self.text(panel.left - 5, panel.y(value) + 4, f"{value:g}", anchor="end")
        self.text(panel.left + panel.width / 2, panel.bottom + 28, x_label, "label")
        self.text(panel.left - 5, panel.top - 8, y_label, "label", "start")

    def curve(
        self, panel: Panel, x: NDArray[np.float64], y: NDArray[np.float64], style: str
    ) -> None:
        """Draw a line through finite points, interrupted at others, in visible detail."""
        for part in _finite_parts(np.asarray(x, np.float64), np.asarray(y, np.float64)):
            places = [(_n(panel.x(a)), _n(panel.y(b))) for a, b in part]
            kept = [
                p
                for i, p in enumerate(places)
                if i in (0, len(places) - 1) or not places[i - 1] == p == places[i + 1]
            ]
            path = " ".join(f"{a},{b}" for a, b in kept)
            self._parts.append(f'<polyline points="{path}" class="{style}"/>')

    def band(
        self,
        panel: Panel,
        x: NDArray[np.float64],
        low: NDArray[np.float64],
        high: NDArray[np.float64],
        style: str,
    ) -> None:
        """Draw the area between two lines."""
        there = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
        if there.sum() < 2:
            return
        forth = [(panel.x(a), panel.y(b)) for a, b in zip(x[there], high[there], strict=True)]
        back = [(panel.x(a), panel.y(b)) for a, b in zip(x[there], low[there], strict=True)]
        path = " ".join(f"{_n(a)},{_n(b)}" for a, b in [*forth, *reversed(back)])
        self._parts.append(f'<polygon points="{path}" class="{style}"/>')

    def dot(self, x: float, y: float, radius: float, style: str, hint: str = "") -> None:
        """Draw a filled circle; the hint is its tooltip."""
        inside = f"<title>{escape(hint)}</title>" if hint else ""
        self._parts.append(
            f'<circle cx="{_n(x)}" cy="{_n(y)}" r="{_n(radius)}" class="{style}">{inside}</circle>'
        )

    def cross(self, x: float, y: float, style: str, hint: str = "") -> None:
        """Draw a cross, which marks a failure; the hint is its tooltip."""
        inside = f"<title>{escape(hint)}</title>" if hint else ""
        path = f"M{_n(x - 3.5)} {_n(y - 3.5)}l7 7m0 -7l-7 7"
        self._parts.append(f'<path d="{path}" class="{style}">{inside}</path>')

    def legend(self, x: float, y: float, entries: Sequence[tuple[str, str]]) -> None:
        """Draw a row of swatches, each with a style and a text."""
        for style, text in entries:
            self.rule(x, y - 4, x + 14, y - 4, style)
            self.text(x + 18, y, text, "tick", "start")
            x += 30 + 6.2 * len(text)


def thinned(rows: int) -> NDArray[np.intp]:
    """Return the rows of a line to draw, so that the page of an hour's drive stays small."""
    return np.unique(np.linspace(0, rows - 1, min(rows, POINTS)).astype(np.intp))


def ticks(low: float, high: float, max_count: int = 6) -> list[float]:
    """Return round values within a range, whose ends may be in either order."""
    low, high = min(low, high), max(low, high)
    rough = (high - low) / max_count
    scale = 10.0 ** math.floor(math.log10(rough))
    step = next(m * scale for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * scale >= rough)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [round(i * step, 10) for i in range(first, last + 1)]


def _finite_parts(
    x: NDArray[np.float64], y: NDArray[np.float64]
) -> list[list[tuple[float, float]]]:
    parts: list[list[tuple[float, float]]] = [[]]
    for a, b in zip(x.tolist(), y.tolist(), strict=True):
        if math.isfinite(a) and math.isfinite(b):
            parts[-1].append((a, b))
        elif parts[-1]:
            parts.append([])
    return [part for part in parts if len(part) > 1]


def _n(value: float) -> str:
    return f"{value:.1f}".removesuffix(".0")
