"""Show metrics of scored runs over versions, commits or tags."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

from markupsafe import Markup

from crosscue.eval.catalog.history import History, MetricHistory, history_of, limits
from crosscue.eval.catalog.query.catalog import catalog
from crosscue.eval.report.html import short, write_page
from crosscue.eval.report.svg_plot import Panel, SvgChart, ticks
from crosscue.replay.errors import OutputError
from crosscue.verb import Option

WIDTH: Final = 460.0
HEIGHT: Final = 190.0
# Width of a version's name below a chart.
LABEL_PX: Final = 52.0


def history(
    folder: Annotated[Path | str, Option(metavar="RUNS")],
    output: Annotated[Path | str | None, Option(metavar="HTML")] = None,
    by: Annotated[str, Option(metavar="WHAT")] = "commit",
    metrics: Annotated[Sequence[str], Option(metavar="PATTERN")] = (),
    *,
    overwrite: bool = False,
) -> History:
    """Show metrics over versions, and where they changed.

    The page needs no network and runs no script. For each metric, it shows the value and its 95 %
    interval under each version, and marks change points. From a change point on, the metric differs
    by more than chance, judged drive by drive. A history without any change shows a change point in
    at most 5 % of cases, over all metrics together. With fewer than six drives, nothing is decided.

    Versions are ordered by the time of their first run. If a drive has several runs under one
    version, the latest counts.

    Examples:
        crosscue history runs -o history.html
        crosscue history runs --by model -o history.html --metrics 'cues.*.recall' 'approaches.*'

    Args:
        folder: Folder of scored runs.
        output: Page to write.
        by: Group runs by commit, by version of crosscue, or by this tag.
        metrics: Only these metrics.
        overwrite: Replace an existing page.

    Raises:
        RunError: The folder contains no run.
        EmptyResultError: No scored run records its version, or no metric matches.
        OutputError: The page exists, or cannot be written.
    """
    page = None if output is None else Path(output)
    if page is not None and page.exists() and not overwrite:
        raise OutputError(f"{page}: exists; give another name or --overwrite")
    found = history_of(catalog(folder), by, metrics)
    if page is not None:
        content = {
            "title": f"History by {by}",
            "folder": str(folder),
            "found": found,
            "charts": [draw_chart(one, found.versions) for one in found.metrics],
            **limits(),
        }
        write_page(page, "history.html.j2", content)
    return found


def draw_chart(one: MetricHistory, versions: Sequence[str]) -> Markup:
    """Draw values with intervals, and change points as vertical lines."""
    ends = [end for point in one.points for end in (point.value, point.low, point.high)]
    known = [end for end in ends if math.isfinite(end)]
    low, high = min(known, default=0.0), max(known, default=1.0)
    margin = 0.08 * (high - low) or max(abs(high) * 0.05, 0.01)
    last = max(len(versions) - 1, 1)
    panel = Panel(
        52, 14, WIDTH - 66, HEIGHT - 48, (-0.4, last + 0.4), (low - margin, high + margin)
    )
    turns = [(change.at, "better" if one.is_better(change) else "worse") for change in one.changes]
    what = ", ".join(f"{verdict} from {versions[at]} on" for at, verdict in turns)
    drawing = SvgChart(WIDTH, HEIGHT, one.path, f"{len(versions)} versions; {what or 'no change'}")
    _draw_axis(drawing, panel, one, versions)
    for at, verdict in turns:
        x = panel.x(at - 0.5)
        drawing.rule(x, panel.top, x, panel.bottom, f"change {verdict}")
    for at, point in enumerate(one.points):
        if not math.isfinite(point.value):
            continue
        x, between = panel.x(at), ""
        if math.isfinite(point.low):
            drawing.rule(x, panel.y(point.low), x, panel.y(point.high), "ends")
            between = f", 95 % {point.low:.4g} to {point.high:.4g}"
        hint = f"{versions[at]}: {point.value:.4g}{between}; {point.drives} drives"
        drawing.dot(x, panel.y(point.value), 3.5, "point", hint)
    return drawing.svg()


def _draw_axis(
    drawing: SvgChart, panel: Panel, one: MetricHistory, versions: Sequence[str]
) -> None:
    for value in ticks(*panel.y_range, 4):
        drawing.rule(panel.left, panel.y(value), panel.right, panel.y(value), "grid")
        drawing.text(panel.left - 6, panel.y(value) + 4, f"{value:g}", anchor="end")
    taken: list[float] = []
    # The most important versions are named first; names that would overlap are left out.
    wanted = [*(mark.at for mark in one.changes), 0, len(versions) - 1, *range(len(versions))]
    for at in dict.fromkeys(wanted):
        x = panel.x(at)
        if all(abs(x - other) >= LABEL_PX for other in taken):
            drawing.text(x, panel.bottom + 15, short(versions[at]))
            taken.append(x)
