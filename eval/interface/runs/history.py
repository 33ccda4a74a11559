"""Show metrics of scored runs over versions, commits or tags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from crosscue.eval.catalog.history import History, MetricHistory, history_of, limits
from crosscue.eval.catalog.query.catalog import catalog
from crosscue.eval.report.history_page import Chart, Mark, write_history_page
from crosscue.replay.base import OutputError


def history(
    folder: Path | str,
    output: Path | str | None = None,
    by: str = "commit",
    metrics: Sequence[str] = (),
    *,
    overwrite: bool = False,
) -> History:
    """Return each metric by version of the runs, with its change points.

    Args:
        folder: Folder of scored runs.
        output: HTML page to write; None for none.
        by: ``commit`` or ``version`` of crosscue, or the name of a tag.
        metrics: Patterns of metrics' names, such as ``cues.*.recall``; default: all metrics.
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
            Mark(
                change.at,
                "better" if one.is_better(change) else "worse",
                points[change.at - 1].value,
                points[change.at].value,
                change.p,
            )
            for change in one.changes
        ],
    )
