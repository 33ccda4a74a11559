"""Show metrics of scored runs over versions, commits or tags."""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from crosscue.eval.catalog.paired import by_place, pooled
from crosscue.eval.catalog.query.catalog import Catalog, catalog
from crosscue.eval.report.html import short, write_page
from crosscue.eval.report.svg_plot import Panel, SvgChart, ticks
from crosscue.eval.scoring.by_drive import DriveMetric, Kind, direction
from crosscue.eval.scoring.change_points import (
    FALSE_ALARMS,
    SHUFFLES,
    ChangePoint,
    Results,
    change_points,
)
from crosscue.eval.scoring.intervals import MIN_CLUSTERS
from crosscue.eval.scoring.places import group_drives
from crosscue.replay.columns import Int64s
from crosscue.replay.errors import EmptyResultError, OutputError
from crosscue.replay.safe_text import counted
from crosscue.results import Result
from crosscue.verb import Option

WIDTH: Final = 460.0
HEIGHT: Final = 190.0
# Width of a version's name below a chart.
LABEL_PX: Final = 52.0

# Column of ``runs`` by the value of ``--by``; any other value is the name of a tag.
BY: Final[Mapping[str, str]] = {"commit": "crosscue_commit", "version": "crosscue"}


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
    drawing = SvgChart(
        WIDTH, HEIGHT, one.path, f"{counted(len(versions), 'version')}; {what or 'no change'}"
    )
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
        hint = f"{versions[at]}: {point.value:.4g}{between}; {counted(point.drives, 'drive')}"
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


@dataclass(frozen=True, slots=True)
class VersionPoint:
    """A metric under one version.

    Attributes:
        value: Value pooled over the version's drives; NaN if no drive has the metric.
        low: Lower end of the 95 % interval over places; NaN below six places.
        high: Upper end of the interval.
        drives: Number of drives pooled.
    """

    value: float
    low: float
    high: float
    drives: int


@dataclass(frozen=True, slots=True)
class MetricHistory:
    """A metric over all versions.

    Attributes:
        path: Name of the metric.
        better: Good direction of the metric.
        points: One point for each version.
        changes: Change points.
    """

    path: str
    better: str
    points: tuple[VersionPoint, ...]
    changes: tuple[ChangePoint, ...]

    def is_better(self, change: ChangePoint) -> bool:
        """Return whether the pooled metric is better after this change point than before."""
        return (change.by > 0.0) == (self.better == "higher")


@dataclass(frozen=True, slots=True, repr=False)
class History(Result):
    """Metrics over versions; its text is the output of ``crosscue history``.

    Attributes:
        by: Kind of the versions: ``commit``, ``version`` or a tag's name.
        versions: Versions in the order in which their first run was made.
        drives: Number of drives with a scored run, by version.
        metrics: Scored metrics, those that changed first.
        left_out: Number of runs left out, by reason.
    """

    by: str
    versions: tuple[str, ...]
    drives: tuple[int, ...]
    metrics: tuple[MetricHistory, ...]
    left_out: Mapping[str, int]

    @property
    def changed(self) -> tuple[MetricHistory, ...]:
        """Metrics with a change point."""
        return tuple(one for one in self.metrics if one.changes)

    def lines(self) -> Iterator[str]:
        """Yield each change, and the number of metrics."""
        yield from _lines(self)


def _lines(found: History) -> Iterator[str]:
    for one in found.changed:
        for change in one.changes:
            word = "better" if one.is_better(change) else "WORSE"
            before, after = (one.points[change.at + i].value for i in (-1, 0))
            yield (
                f"{word:11}{one.path}: {before:.4g} -> {after:.4g} from {found.by} "
                f"{found.versions[change.at]} on (p {change.p:.2g})"
            )
    for why, count in found.left_out.items():
        yield f"left out   {counted(count, 'run')} {why}"
    yield (
        f"history    {counted(len(found.metrics), 'metric')} over "
        f"{counted(len(found.versions), found.by)}; {len(found.changed)} changed"
    )


def history_of(catalog: Catalog, by: str, patterns: Sequence[str] = ()) -> History:
    """Return the history of every judged metric.

    Args:
        catalog: The runs.
        by: ``commit``, ``version``, or the name of a tag.
        patterns: Patterns of metric names; empty selects all metrics.

    Raises:
        EmptyResultError: No scored run records its version, or no metric matches.
    """
    runs = _runs(catalog, by)
    left_out = {
        "without a score": sum(not one["is_scored"] for one in runs),
        f"without a {by}": sum(one["is_scored"] and one["version"] is None for one in runs),
    }
    usable = [one for one in runs if one["is_scored"] and one["version"] is not None]
    if not usable:
        raise EmptyResultError(
            f"history: no scored run of {len(runs)} has a {by}; score them, or choose another --by"
        )
    # The latest run of a drive represents it under a version.
    chosen = {(one["version"], one["identity"]): one["run"] for one in usable}
    left_out["replaced by a later run of the same drive"] = len(usable) - len(chosen)
    versions = list(dict.fromkeys(one["version"] for one in usable))
    place = {run: versions.index(version) for (version, _), run in chosen.items()}
    parts = _parts(catalog, place, patterns)
    if not parts:
        raise EmptyResultError(
            f"history: no judged metric fits {', '.join(patterns) or 'any name'}; see score --json"
        )
    counts = [sum(at == i for at in place.values()) for i in range(len(versions))]
    return History(
        by,
        tuple(versions),
        tuple(counts),
        _metrics(parts, len(versions)),
        {why: count for why, count in left_out.items() if count},
    )


def limits() -> dict[str, object]:
    """Return the parameters that define a change point."""
    return {
        "shuffles": SHUFFLES,
        "alarms": round(100.0 * FALSE_ALARMS),
        "min_places": MIN_CLUSTERS,
    }


def _runs(catalog: Catalog, by: str) -> list[dict[str, Any]]:
    column = BY.get(by, "tags['{}']".format(by.replace("'", "''")))
    # The name is quoted, and a query can only read the catalog's tables.
    sql = (
        f"select run, coalesce(identity, run) as identity, is_scored, {column} as version "  # noqa: S608
        "from runs order by made_at, run"
    )
    rows: list[dict[str, Any]] = catalog.query(sql).to_pylist()
    return rows


def _parts(
    catalog: Catalog, place: Mapping[str, int], patterns: Sequence[str]
) -> dict[str, list[tuple[int, DriveMetric]]]:
    """Return each drive's contribution with the index of its version, by metric."""
    found: dict[str, list[tuple[int, DriveMetric]]] = {}
    table = catalog.query(
        "select s.run, coalesce(r.identity, r.run) as log, metric, kind, total, rows, "
        "coalesce(places, []) as places "
        "from scores s join runs r on s.run = r.run order by metric, s.run"
    )
    wanted: dict[str, bool] = {}
    for row in table.to_pylist():
        path, run = row["metric"], row.pop("run")
        if path not in wanted:
            fits = not patterns or any(fnmatch.fnmatchcase(path, one) for one in patterns)
            wanted[path] = fits and direction(path) is not None
        if wanted[path] and run in place:
            found.setdefault(path, []).append((place[run], DriveMetric(**row)))
    return found


def _metrics(
    parts: Mapping[str, Sequence[tuple[int, DriveMetric]]], versions: int
) -> tuple[MetricHistory, ...]:
    logs = {log: i for i, log in enumerate(sorted({m.log for of in parts.values() for _, m in of}))}
    places: list[set[str]] = [set() for _ in logs]
    for _, one in (pair for of in parts.values() for pair in of):
        places[logs[one.log]].update(one.places)
    names = [sorted(some) or [f"log {log}"] for log, some in zip(logs, places, strict=True)]
    where = group_drives(names)
    sums = {}
    for path, of in parts.items():
        total, rows = np.zeros((len(logs), versions)), np.zeros((len(logs), versions))
        for at, one in of:
            total[logs[one.log], at] += one.total
            rows[logs[one.log], at] += one.rows
        sums[path] = (of[0][1].kind, total, rows)
    changes = change_points({path: _results(*one, where) for path, one in sums.items()})
    found = []
    for path, (kind, total, rows) in sums.items():
        points = tuple(_point(kind, total[:, at], rows[:, at], where) for at in range(versions))
        found.append(MetricHistory(path, str(direction(path)), points, changes[path]))
    return tuple(sorted(found, key=lambda one: (not one.changes, one.path)))


def _results(
    kind: Kind, total: NDArray[np.float64], rows: NDArray[np.float64], where: Int64s
) -> Results:
    is_known = rows > 0.0
    values = np.divide(total, rows, out=np.full(total.shape, math.nan), where=is_known)
    known = is_known.sum(axis=1)
    weights = np.divide(rows.sum(axis=1), known, out=np.zeros(len(rows)), where=known > 0)
    return Results(total if kind == "sum" else values, weights, where)


def _point(
    kind: Kind, total: NDArray[np.float64], rows: NDArray[np.float64], where: Int64s
) -> VersionPoint:
    value, half = pooled(kind, by_place(total, where), by_place(rows, where))
    return VersionPoint(value, value - half, value + half, int((rows > 0.0).sum()))
