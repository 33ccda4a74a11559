"""Two runs side by side: what changed in versions, settings, tables and metrics, and what is worse.

A metric is worse when it moved in its bad direction by more than its tolerance. Where a run was not
scored there are no metrics to judge by; then every difference of a table counts.
"""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeVar

import numpy as np

from crosscue.eval.runs.folder import MANIFEST, RunFolder, open_run
from crosscue.eval.scoring.metric_values import MetricValue, metric_values
from crosscue.eval.scoring.runs import FOLDER, METRICS
from crosscue.replay.base import (
    MIB,
    UnreadableRunError,
    UsageError,
    json_tree,
    read_at_most,
    visible,
)

if TYPE_CHECKING:
    import pyarrow as pa

T = TypeVar("T")
Direction = Literal["higher", "lower"]
BETTER: Final[Mapping[str, Direction]] = {
    **dict.fromkeys(
        ("precision", "recall", "scored", "matched", "detected", "full", "full_from_8_m",
         "detected_m", "full_m"), "higher",
    ),
    **dict.fromkeys(
        ("brier", "log_score", "rmse", "rmse_m", "p95_m", "ape_rmse_m", "extra", "extra_detected",
         "splits", "false_features", "lost"), "lower",
    ),
}  # fmt: skip
"""By the last part of a metric's path; metrics of other names are shown but not judged."""
PARTS: Final = (
    "by_distance",
    "by_condition",
    "by_intersection",
    "by_drive",
    "readings",
    "things",
    "attribution",
)
"""Metrics below these stand on few rows each; they are shown but not judged."""
COMPARED: Final = {
    "versions", "settings", "detectors", "camera", "selection", "logs", "landmarks",
}  # fmt: skip
"""Parts of a manifest."""
MAX_BYTES: Final = 256 * MIB
MAX_LINES: Final = 20
"""Of settings, and of metrics, in the printed comparison."""


class Tolerance(NamedTuple):
    """How much worse the metrics of a pattern may be; a fraction of the first run's value if so."""

    pattern: str
    by: float
    is_fraction: bool

    def allowed(self, before: float) -> float:
        """In the metric's own unit."""
        return self.by * abs(before) if self.is_fraction else self.by


NONE: Final = Tolerance("*", 0.0, False)


@dataclass(frozen=True, slots=True)
class Change:
    """A setting or version that differs; None where a run lacks it."""

    path: str
    before: object
    after: object


@dataclass(frozen=True, slots=True)
class ColumnChange:
    """How far a column differs.

    Attributes:
        rows: With another value.
        largest: Largest absolute difference of numbers; NaN for other columns.
    """

    rows: int
    largest: float


@dataclass(frozen=True, slots=True)
class TableChange:
    """A table that differs.

    Attributes:
        name: Without its suffix.
        what: In one phrase.
        rows_before: None where it is not there.
        rows_after: The same.
        columns: Those that differ; empty where rows cannot be compared one by one.
    """

    name: str
    what: str
    rows_before: int | None
    rows_after: int | None
    columns: dict[str, ColumnChange]


@dataclass(frozen=True, slots=True)
class MetricChange:
    """A metric that differs; NaN where a run lacks it.

    Attributes:
        path: As in gates.
        before: Value in the first run.
        after: In the second.
        better: Its good direction, or None where it is not judged.
        allowed: How much worse it may be.
        is_worse: Beyond that.
    """

    path: str
    before: float
    after: float
    better: Direction | None
    allowed: float
    is_worse: bool


@dataclass(frozen=True, slots=True, repr=False)
class Comparison:
    """Everything that differs between two runs; printed as ``crosscue compare`` prints it.

    Attributes:
        changes: Versions, settings, detectors, selection, logs.
        tables: Tables that differ.
        metrics: Metrics that differ.
        tables_same: How many tables are equal.
        metrics_same: How many metrics are equal.
        why_no_metrics: Empty where both runs were scored.
        is_whole: Nothing was dropped in either.
    """

    changes: tuple[Change, ...]
    tables: tuple[TableChange, ...]
    metrics: tuple[MetricChange, ...]
    tables_same: int
    metrics_same: int
    why_no_metrics: str
    is_whole: bool = True

    @property
    def worse(self) -> tuple[str, ...]:
        """What makes the second run worse."""
        found = tuple(one.path for one in self.metrics if one.is_worse)
        if self.why_no_metrics:
            found += tuple(f"table {one.name}" for one in self.tables)
        return found

    def as_dict(self) -> dict[str, object]:
        """What ``crosscue compare --json`` prints."""
        tree = asdict(self)
        del tree["is_whole"]
        return tree | {"worse": self.worse}

    def __repr__(self) -> str:
        return "\n".join(_lines(self))


def read_tolerance(text: str) -> Tolerance:
    """``0.01``, ``2%`` or ``PATTERN=0.01`` as a tolerance.

    Raises:
        UsageError: Neither.
    """
    pattern, _, number = text.rpartition("=")
    is_fraction = number.endswith("%")
    try:
        by = float(number.removesuffix("%")) / (100.0 if is_fraction else 1.0)
    except ValueError:
        by = math.nan
    if not (math.isfinite(by) and by >= 0.0):
        raise UsageError(
            f"--tolerance {text}: expected 0.01, 2% or PATTERN=0.01, such as "
            "'cues.*.precision=0.02'"
        )
    return Tolerance(pattern or "*", by, is_fraction)


def compare_runs(
    first: RunFolder, second: RunFolder, tolerances: Sequence[Tolerance] = ()
) -> Comparison:
    """Compare two finished runs, or the pooled scores of several.

    Args:
        first: The one that was good; see ``open_scored``.
        second: The one to judge.
        tolerances: The last one whose pattern fits a metric counts; without any, none.

    Raises:
        RunError: A manifest, table or score cannot be read.
    """
    manifests = [_settings_of(run) for run in (first, second)]
    changes = tuple(
        Change(path, manifests[0].get(path), manifests[1].get(path))
        for path in dict.fromkeys([*manifests[0], *manifests[1]])
        if manifests[0].get(path) != manifests[1].get(path)
    )
    names = sorted({path.stem for run in (first, second) for path in run.path.glob("*.parquet")})
    tables = [found for name in names if (found := _compare_table(name, first, second)) is not None]
    scores = [_metrics_of(run) for run in (first, second)]
    same = len(names) - len(tables)
    is_whole = _is_whole_run(first) and _is_whole_run(second)
    if scores[0] is None or scores[1] is None:
        bare = [
            str(run.path)
            for run, found in zip((first, second), scores, strict=True)
            if found is None
        ]
        why = f"not scored: {', '.join(bare)}"
        return Comparison(changes, tuple(tables), (), same, 0, why, is_whole)
    metrics, metrics_same = compare_metrics(scores[0], scores[1], tolerances)
    return Comparison(changes, tuple(tables), metrics, same, metrics_same, "", is_whole)


def open_scored(path: Path) -> RunFolder:
    """A finished run, or the folder that ``crosscue score -o`` wrote for several runs.

    Raises:
        RunError: Neither.
    """
    return RunFolder(path) if _is_pooled(path) else open_run(path)


def _is_whole_run(run: RunFolder) -> bool:
    """Was nothing dropped in the run, or in any of those that were scored together?"""
    if not _is_pooled(run.path):
        return run.manifest().account.is_whole
    account = _tree_of(run.file(METRICS)).get("account")
    return isinstance(account, dict) and bool(account.get("is_whole"))


def _is_pooled(path: Path) -> bool:
    return not (path / MANIFEST).exists() and (path / METRICS).exists()


def _settings_of(run: RunFolder) -> dict[str, object]:
    if _is_pooled(run.path):
        return {}
    return dict(_leaves(run.manifest().model_dump(mode="json", include=COMPARED), ""))


def _leaves(value: object, path: str) -> Iterator[tuple[str, object]]:
    if isinstance(value, Mapping) and value:
        for name, branch in value.items():
            yield from _leaves(branch, f"{path}.{name}" if path else str(name))
    elif isinstance(value, list) and any(isinstance(one, Mapping) for one in value):
        for place, branch in enumerate(value):
            yield from _leaves(branch, f"{path}.{place}")
    else:
        yield path, value


def _metrics_of(run: RunFolder) -> dict[str, MetricValue] | None:
    path = run.file(METRICS) if _is_pooled(run.path) else run.file(FOLDER) / METRICS
    if not path.exists():
        return None
    left_out = ("truth", "settings", "format", "account")
    judged = {name: branch for name, branch in _tree_of(path).items() if name not in left_out}
    return metric_values(judged, parts=False)


def _tree_of(path: Path) -> dict[str, Any]:
    try:
        content = read_at_most(path, MAX_BYTES)
        if content is None:
            raise UnreadableRunError(
                f"{path}: over {MAX_BYTES // MIB} MiB; run crosscue score again"
            )
        tree = json_tree(content)
    except (OSError, ValueError) as error:
        raise UnreadableRunError(
            f"{path}: unreadable ({error}); run crosscue score again"
        ) from None
    if not isinstance(tree, dict):
        raise UnreadableRunError(f"{path}: expected an object; run crosscue score again")
    return tree


def compare_metrics(
    before: Mapping[str, MetricValue],
    after: Mapping[str, MetricValue],
    tolerances: Sequence[Tolerance] = (),
) -> tuple[tuple[MetricChange, ...], int]:
    """Metrics that differ, the worse ones first; and how many are equal."""
    changes: list[MetricChange] = []
    same = 0
    lacking = MetricValue(math.nan)
    for path in dict.fromkeys([*before, *after]):
        old, new = before.get(path, lacking).value, after.get(path, lacking).value
        if old == new or (math.isnan(old) and math.isnan(new)):
            same += 1
            continue
        better = None if set(path.split(".")) & set(PARTS) else BETTER.get(path.rpartition(".")[2])
        tolerance = next(
            (one for one in reversed(tolerances) if fnmatch.fnmatchcase(path, one.pattern)), NONE
        )
        allowed = 0.0 if math.isnan(old) else tolerance.allowed(old)
        changes.append(
            MetricChange(path, old, new, better, allowed, _is_worse(old, new, better, allowed))
        )
    return tuple(sorted(changes, key=lambda one: (not one.is_worse, one.path))), same


def _is_worse(old: float, new: float, better: Direction | None, allowed: float) -> bool:
    if better is None or math.isnan(old):
        return False
    if math.isnan(new):
        return True
    loss = old - new if better == "higher" else new - old
    # Written so that a loss of exactly what is allowed passes in spite of rounding.
    return loss > allowed + 1e-12 * max(abs(old), abs(new))


def _compare_table(name: str, first: RunFolder, second: RunFolder) -> TableChange | None:
    tables = [
        run.table(name) if run.file(f"{name}.parquet").exists() else None for run in (first, second)
    ]
    before, after = tables
    if before is None or after is None:
        what = "only in the second run" if before is None else "only in the first run"
        rows = [None if table is None else table.num_rows for table in tables]
        return TableChange(name, what, rows[0], rows[1], {})
    rows_before, rows_after = before.num_rows, after.num_rows
    if before.schema.remove_metadata() != after.schema.remove_metadata():
        return TableChange(name, _schemas(before, after), rows_before, rows_after, {})
    if rows_before != rows_after:
        return TableChange(name, "another number of rows", rows_before, rows_after, {})
    columns = {}
    for column in before.column_names:
        change = _compare_column(before[column], after[column])
        if change is not None:
            columns[column] = change
    if not columns:
        return None
    return TableChange(name, "other values", rows_before, rows_after, columns)


def _schemas(before: pa.Table, after: pa.Table) -> str:
    """The first column that differs, as in both tables."""
    columns = [[f"{one.name} {one.type}" for one in table.schema] for table in (before, after)]
    for old, new in zip_longest(*columns, fillvalue="nothing"):
        if old != new:
            return f"other columns: {old} and {new}"
    return "other columns: may be null or not"


def _compare_column(before: pa.ChunkedArray, after: pa.ChunkedArray) -> ColumnChange | None:
    import pyarrow as pa

    if before.equals(after):
        return None
    if not (pa.types.is_floating(before.type) or pa.types.is_integer(before.type)):
        rows = sum(a != b for a, b in zip(before.to_pylist(), after.to_pylist(), strict=True))
        return ColumnChange(rows, math.nan)
    # Nulls become NaN; where both runs have none, nothing differs.
    old, new = before.to_numpy(), after.to_numpy()
    differs = (old != new) & ~(np.isnan(old) & np.isnan(new))
    if not differs.any():
        return None
    apart = np.abs(old[differs].astype(np.float64) - new[differs].astype(np.float64))
    known = apart[np.isfinite(apart)]
    return ColumnChange(int(differs.sum()), float(known.max()) if len(known) else math.nan)


def _lines(found: Comparison) -> Iterator[str]:
    for one in _first_of(found.changes, "settings"):
        if isinstance(one, str):
            yield one
        else:
            yield f"setting    {visible(one.path)}: {_short(one.before)} -> {_short(one.after)}"
    for table in found.tables:
        yield from _table_lines(table)
    for metric in _first_of(found.metrics, "metrics"):
        yield metric if isinstance(metric, str) else _metric_line(metric)
    yield (
        f"equal      {found.tables_same} tables, {found.metrics_same} metrics; different: "
        f"{len(found.changes)} settings, {len(found.tables)} tables, {len(found.metrics)} metrics"
    )
    if found.why_no_metrics:
        yield f"{visible(found.why_no_metrics)}; judged by tables alone"
    yield f"worse      {len(found.worse)}" if found.worse else "nothing is worse"


def _first_of(things: tuple[T, ...], what: str) -> Iterator[T | str]:
    yield from things[:MAX_LINES]
    if len(things) > MAX_LINES:
        yield f"           and {len(things) - MAX_LINES} more {what}; --json shows all"


def _short(value: object) -> str:
    text = "nothing" if value is None else visible(str(value))
    return text if len(text) <= 30 else text[:27] + "..."


def _table_lines(one: TableChange) -> Iterator[str]:
    rows = f"{_short(one.rows_before)} and {_short(one.rows_after)} rows"
    yield f"table      {visible(one.name)}: {visible(one.what)} ({rows})"
    for name, column in one.columns.items():
        far = "" if math.isnan(column.largest) else f", by up to {column.largest:.3g}"
        yield f"           {visible(name)}: {column.rows} rows differ{far}"


def _metric_line(one: MetricChange) -> str:
    label = "WORSE" if one.is_worse else "metric"
    allowed = f" (allowed {one.allowed:.3g})" if one.is_worse else ""
    return f"{label:11}{visible(one.path)}: {_value(one.before)} -> {_value(one.after)}{allowed}"


def _value(value: float) -> str:
    return "not scored" if math.isnan(value) else f"{value:.6g}"
