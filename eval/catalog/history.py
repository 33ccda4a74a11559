"""History of every metric over the versions, commits or tags of a catalog's runs."""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.scoring.by_drive import DriveMetric, Kind, direction
from crosscue.eval.scoring.change_points import (
    FALSE_ALARMS,
    MIN_PLACES,
    SHUFFLES,
    ChangePoint,
    Results,
    change_points,
)
from crosscue.eval.scoring.places import group_drives
from crosscue.replay.columns import Int64s
from crosscue.replay.errors import EmptyResultError
from crosscue.results import Result

from .paired import by_place, pooled

if TYPE_CHECKING:
    import pyarrow as pa

# Column of ``runs`` by the value of ``--by``; any other value is the name of a tag.
BY: Final[Mapping[str, str]] = {"commit": "crosscue_commit", "version": "crosscue"}


class RunCatalog(Protocol):
    """A catalog of runs."""

    def query(self, sql: str) -> pa.Table:
        """Return the rows that a query selects."""
        ...


@dataclass(frozen=True, slots=True)
class VersionPoint:
    """A metric under one version.

    Attributes:
        value: Value pooled over the version's drives; NaN if no drive has the metric.
        low: Lower end of the 95 % interval over places; NaN below four places.
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
        yield f"left out   {count} runs {why}"
    yield (
        f"history    {len(found.metrics)} metrics over {len(found.versions)} "
        f"{'versions' if found.by == 'version' else found.by + 's'}; {len(found.changed)} changed"
    )


def history_of(catalog: RunCatalog, by: str, patterns: Sequence[str] = ()) -> History:
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
        "min_places": MIN_PLACES,
    }


def _runs(catalog: RunCatalog, by: str) -> list[dict[str, Any]]:
    column = BY.get(by, "tags['{}']".format(by.replace("'", "''")))
    # The name is quoted, and a query can only read the catalog's tables.
    sql = (
        f"select run, coalesce(identity, run) as identity, is_scored, {column} as version "  # noqa: S608
        "from runs order by made_at, run"
    )
    rows: list[dict[str, Any]] = catalog.query(sql).to_pylist()
    return rows


def _parts(
    catalog: RunCatalog, place: Mapping[str, int], patterns: Sequence[str]
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
