"""Show metrics of scored runs over versions, commits or tags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from crosscue.eval.catalog.history import History, MetricHistory, history_of, limits
from crosscue.eval.catalog.query.catalog import catalog
from crosscue.eval.report.history_page import ChangeMark, Chart, write_history_page
from crosscue.replay.errors import OutputError
from crosscue.verb import Option


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
            "by": by,
            "folder": str(folder),
            "drives": found.drives,
            "left_out": found.left_out,
            **limits(),
        }
        write_history_page(page, found.versions, [_chart(one) for one in found.metrics], content)
    return found


def _chart(one: MetricHistory) -> Chart:
    points = one.points
    return Chart(
        one.path,
        one.better,
        [point.value for point in points],
        [point.low for point in points],
        [point.high for point in points],
        [point.drives for point in points],
        [
            ChangeMark(
                change.at,
                "better" if one.is_better(change) else "worse",
                points[change.at - 1].value,
                points[change.at].value,
                change.p,
            )
            for change in one.changes
        ],
    )
