"""Comparison of two runs: changes of versions, settings, tables and metrics.

Metrics are judged drive by drive (``paired``). If a run was not scored, any difference in a table
counts as a change for the worse.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any, ClassVar, Final, Generic, TypeVar

import numpy as np
import pyarrow as pa

from crosscue.eval.runs.folder import MANIFEST, RunFolder, open_run
from crosscue.eval.scoring.by_drive import (
    BY_DRIVE,
    FOLDER,
    METRICS,
    DriveMetric,
    direction,
    no_longer_scored,
)
from crosscue.eval.scoring.intervals import MIN_CLUSTERS, between
from crosscue.eval.scoring.metric_values import MetricValue, metric_values
from crosscue.replay.errors import UnreadableRunError, UsageError
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import json_tree
from crosscue.replay.limits import MIB
from crosscue.replay.safe_text import counted, visible
from crosscue.results import HIDDEN, Result

from .paired import FALSE_ALARMS, PairedMetric, Tolerance, Verdict, compare_drives

T = TypeVar("T")
# Parts of a manifest that are compared.
COMPARED: Final = {
    "versions",
    "settings",
    "detectors",
    "camera",
    "selection",
    "logs",
    "landmarks",
}
MAX_BYTES: Final = 256 * MIB
# Max lines of settings, and of metrics, in the printed comparison.
MAX_LINES: Final = 20


ORDER: Final[tuple[Verdict, ...]] = ("worse", "better", "undecided", "too few places")


@dataclass(frozen=True, slots=True)
class Change(Generic[T]):
    """What differs: a setting or version, None where a run lacks it, or a metric, then NaN."""

    path: str
    before: T
    after: T


@dataclass(frozen=True, slots=True)
class ColumnChange:
    """Differences in one column.

    Attributes:
        rows: Number of rows whose values differ.
        largest: Largest absolute difference of numbers; NaN for other columns.
    """

    rows: int
    largest: float


@dataclass(frozen=True, slots=True)
class TableChange:
    """A table that differs.

    Attributes:
        name: File name without its suffix.
        what: Description in one phrase.
        rows_before: Rows in the first run; None if it lacks the table.
        rows_after: Rows in the second run; None if it lacks the table.
        columns: Columns that differ; empty if rows cannot be compared one by one.
    """

    name: str
    what: str
    rows_before: int | None
    rows_after: int | None
    columns: dict[str, ColumnChange]


@dataclass(frozen=True, slots=True, repr=False)
class Comparison(Result):
    """Everything that differs between two runs; its ``repr`` is the output of ``crosscue compare``.

    Attributes:
        changes: Differing versions, settings, detectors, selection and logs.
        tables: Tables that differ.
        judged: Metrics of both runs that have a good direction, whether they differ or not.
        metrics: Other metrics that differ.
        no_longer_scored: Metrics that the second run lacks or has no rows for.
        tables_same: Number of equal tables.
        drives: Number of drives in both runs, only in the first, and only in the second.
        why_no_metrics: Reason why metrics were not compared; empty if both runs were scored.
        is_whole: True if no rows were dropped in either run.
        left_out: When many runs are compared, the reason why a run was left out, by run.
        is_many: True if sets of runs are compared.
    """

    changes: tuple[Change[object], ...]
    tables: tuple[TableChange, ...]
    judged: tuple[PairedMetric, ...]
    metrics: tuple[Change[float], ...]
    no_longer_scored: tuple[str, ...]
    tables_same: int
    drives: tuple[int, int, int]
    why_no_metrics: str
    is_whole: bool = field(default=True, metadata=HIDDEN)
    left_out: Mapping[str, str] = field(default_factory=dict)
    is_many: bool = field(default=False, metadata=HIDDEN)

    also: ClassVar = {"worse": "worse", "better": "better"}
    formats: ClassVar = {"markdown": "print a short table, for a pull request"}

    @property
    def exit_status(self) -> int:
        """1 when a metric is worse, 3 when either side has drops, else 0."""
        return 0 if self.is_passed and self.is_whole else 3 if self.is_passed else 1

    @property
    def better(self) -> tuple[str, ...]:
        """Metrics that are better."""
        return self.of("better")

    @property
    def worse(self) -> tuple[str, ...]:
        """Metrics that are worse, or no longer scored."""
        return (*self.of("worse"), *self.no_longer_scored)

    @property
    def is_passed(self) -> bool:
        """True if nothing is worse, or, for runs that were not scored, if no table differs."""
        return not (self.worse or (self.why_no_metrics and self.tables))

    def of(self, verdict: Verdict) -> tuple[str, ...]:
        """Paths of the metrics with this verdict."""
        return tuple(one.path for one in self.judged if one.verdict == verdict)

    def cases(self) -> tuple[tuple[str, str], ...]:
        """Test cases for CI: the name of each metric and its failure message, empty if passed."""
        judged = [(one.path, _failure(one)) for one in self.judged]
        missing = [(path, "no longer scored") for path in self.no_longer_scored]
        tables = [(one.name, one.what) for one in self.tables] if self.why_no_metrics else []
        return (*judged, *missing, *tables)

    def markdown(self) -> str:
        """Return a short table of better, worse and undecided metrics for a pull request."""
        return "\n".join(_markdown_lines(self))

    def lines(self) -> Iterator[str]:
        """Yield changes of settings and tables, and the verdict on each metric."""
        yield from _lines(self)


def read_tolerance(text: str) -> Tolerance:
    """Parse ``0.01``, ``2%`` or ``PATTERN=0.01``.

    Raises:
        UsageError: The text has none of these forms.
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
        first: The reference run, from ``open_scored``.
        second: The run to judge.
        tolerances: The last one whose pattern matches a metric applies; if none does, no loss is
            allowed.

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
    is_whole = is_whole_run(first) and is_whole_run(second)
    parts = [run_contributions(run) for run in (first, second)]
    before, after = parts
    if None in scores or before is None or after is None:
        bare = [
            str(run.path)
            for run, found, part in zip((first, second), scores, parts, strict=True)
            if found is None or part is None
        ]
        why = f"not scored, or by an earlier version: {', '.join(bare)}"
        return Comparison(changes, tuple(tables), (), (), (), same, (0, 0, 0), why, is_whole)
    judged = compare_drives(before, after, tolerances)
    logs = [{one.log for one in part} for part in (before, after)]
    counts = (len(logs[0] & logs[1]), len(logs[0] - logs[1]), len(logs[1] - logs[0]))
    others = _others(scores[0] or {}, scores[1] or {})
    missing = no_longer_scored(before, after)
    return Comparison(changes, tuple(tables), judged, others, missing, same, counts, "", is_whole)


def run_contributions(run: RunFolder) -> list[DriveMetric] | None:
    """Return each drive's contribution to the metrics; None if the run was not scored."""
    folder = run if _is_pooled(run.path) else RunFolder(run.file(FOLDER))
    if not folder.file(f"{BY_DRIVE}.parquet").exists():
        return None
    table = folder.table(BY_DRIVE)
    if "places" not in table.column_names:
        return None
    return [DriveMetric(**row) for row in table.to_pylist()]


def open_scored(path: Path) -> RunFolder:
    """Open a finished run, or the folder that ``crosscue score -o`` wrote for several runs.

    Raises:
        RunError: The path is neither.
    """
    return RunFolder(path) if _is_pooled(path) else open_run(path)


def is_whole_run(run: RunFolder) -> bool:
    """Return whether no rows were dropped in the run, or in any of the runs scored together."""
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
        tree = json_tree(door.read(path, MAX_BYTES))
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise UnreadableRunError(f"{path}: unreadable ({why}); run crosscue score again") from None
    if not isinstance(tree, dict):
        raise UnreadableRunError(f"{path}: expected an object; run crosscue score again")
    return tree


def _others(
    before: Mapping[str, MetricValue], after: Mapping[str, MetricValue]
) -> tuple[Change[float], ...]:
    """Return the metrics that differ and are not judged.

    Metrics of a single drive are named after its run folder. If only one side has that folder, they
    are not a change.
    """
    lacking = MetricValue(math.nan)
    changes = []
    for path in dict.fromkeys([*before, *after]):
        if BY_DRIVE in path.split(".") and not (path in before and path in after):
            continue
        old, new = before.get(path, lacking).value, after.get(path, lacking).value
        is_same = old == new or (math.isnan(old) and math.isnan(new))
        if not is_same and direction(path) is None:
            changes.append(Change(path, old, new))
    return tuple(changes)


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
        return TableChange(name, "different number of rows", rows_before, rows_after, {})
    columns = {}
    for column in before.column_names:
        change = _compare_column(before[column], after[column])
        if change is not None:
            columns[column] = change
    if not columns:
        return None
    return TableChange(name, "other values", rows_before, rows_after, columns)


def _schemas(before: pa.Table, after: pa.Table) -> str:
    """Return the first column that differs, as it is in both tables."""
    columns = [[f"{one.name} {one.type}" for one in table.schema] for table in (before, after)]
    for old, new in zip_longest(*columns, fillvalue="nothing"):
        if old != new:
            return f"different columns: {old} and {new}"
    return "different columns: null values allowed in one only"


def _compare_column(before: pa.ChunkedArray, after: pa.ChunkedArray) -> ColumnChange | None:
    if before.equals(after):
        return None
    if not (pa.types.is_floating(before.type) or pa.types.is_integer(before.type)):
        rows = sum(a != b for a, b in zip(before.to_pylist(), after.to_pylist(), strict=True))
        return ColumnChange(rows, math.nan)
    # Nulls become NaN; two NaN are equal.
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
    ranked = sorted(found.judged, key=lambda one: (ORDER.index(one.verdict), one.path))
    differing = tuple(one for one in ranked if one.before != one.after)
    for judged in _first_of(differing, "judged metrics"):
        yield from [judged] if isinstance(judged, str) else _judged_lines(judged)
    for path in found.no_longer_scored:
        yield f"WORSE      {visible(path)}: no longer scored"
    for metric in _first_of(found.metrics, "metrics"):
        if isinstance(metric, str):
            yield metric
        else:
            change = f"{_value(metric.before)} -> {_value(metric.after)}"
            yield f"metric     {visible(metric.path)}: {change}"
    same = len(found.judged) - len(differing)
    if found.is_many:
        yield f"equal      {same} judged metrics; different: {len(differing)}"
        for name, why in found.left_out.items():
            yield f"left out   {visible(name)}: {visible(why)}"
        yield from _verdict_lines(found, len(differing))
        return
    yield (
        f"equal      {counted(found.tables_same, 'table')}, {counted(same, 'judged metric')}; "
        f"different: {counted(len(found.changes), 'setting')}, "
        f"{counted(len(found.tables), 'table')}, "
        f"{counted(len(differing), 'judged metric')}, {counted(len(found.metrics), 'other')}"
    )
    if found.why_no_metrics:
        yield f"{visible(found.why_no_metrics)}; judged by tables alone"
        yield (
            f"different  {counted(len(found.tables), 'table')}"
            if found.tables
            else "nothing differs"
        )
        return
    yield from _verdict_lines(found, len(differing))


def _failure(one: PairedMetric) -> str:
    if one.verdict != "worse":
        return ""
    return (
        f"{_value(one.before)} -> {_value(one.after)}, 95 % {one.low:+.3g} to {one.high:+.3g} "
        f"over {counted(one.places, 'place')}"
    )


def _markdown_lines(found: Comparison) -> Iterator[str]:
    both, only_first, only_second = found.drives
    counts = [len(found.worse), len(found.of("better"))]
    differing = [one for one in found.judged if one.before != one.after]
    undecided = [one for one in differing if one.verdict == "undecided"]
    yield (
        f"**{counts[0]} worse, {counts[1]} better, {len(undecided)} undecided"
        f"{_few_text(found)}**, "
        f"{len(found.judged) - len(differing)} equal, over {counted(both, 'drive')}"
    )
    notes = [
        f"{counted(only_first, 'drive')} only before, {only_second} only after"
        if only_first or only_second
        else "",
        f"{counted(len(found.left_out), 'run')} left out" if found.left_out else "",
        f"{visible(found.why_no_metrics)}; "
        f"{counted(len(found.tables), 'table differs', 'tables differ')}"
        if found.why_no_metrics
        else "",
    ]
    yield from (f"\n{note}." for note in notes if note)
    shown = sorted(differing, key=lambda one: (ORDER.index(one.verdict), one.p, one.path))
    if shown or found.no_longer_scored:
        yield "\n| metric | before | after | difference (95 %) | places | verdict |"
        yield "|---|---|---|---|---|---|"
    for path in found.no_longer_scored:
        yield f"| {_cell(path)} | | | | | **worse**: no longer scored |"
    kept = max(MAX_LINES, sum(counts))
    for one in shown[:kept]:
        ends = between(one.low, one.high, "+.3g")
        verdict = "**worse**" if one.verdict == "worse" else one.verdict
        more = _more_text(one)
        yield (
            f"| {_cell(one.path)} | {one.before:.4g} | {one.after:.4g} | "
            f"{one.after - one.before:+.3g} ({ends}) | {one.places} | {verdict}{more} |"
        )
    if len(shown) > kept:
        yield f"\n{len(shown) - kept} more are undecided."


def _cell(text: str) -> str:
    """Return text without terminal control characters and table separators."""
    return f"`{visible(text).replace('|', '/').replace('`', '')}`"


def _verdict_lines(found: Comparison, differing: int) -> Iterator[str]:
    both, only_first, only_second = found.drives
    left_out = f"; {only_first} only in the first, {only_second} only in the second"
    where = "on both sides" if found.is_many else "in both runs"
    yield f"drives     {both} {where}" + (left_out if only_first or only_second else "")
    places = max((one.places for one in found.judged), default=0)
    if differing and places < MIN_CLUSTERS:
        yield f"           too few places: {places}, {MIN_CLUSTERS} wanted for a verdict"
    elif differing:
        yield (
            f"           a metric that did not change gets a verdict in at most "
            f"{100 * FALSE_ALARMS:.0f} % of comparisons, over all metrics"
        )
    worse, better = len(found.worse), len(found.of("better"))
    undecided = sum(one.verdict == "undecided" and one.before != one.after for one in found.judged)
    yield (
        f"worse      {worse or 'nothing is worse'}; better {better or 'nothing'}; "
        f"undecided {undecided or 'nothing'}{_few_text(found)}"
    )


def _few_text(found: Comparison) -> str:
    """Return the number of metrics that differ at too few places, as a suffix."""
    few = sum(one.verdict == "too few places" and one.before != one.after for one in found.judged)
    return f", {few} at too few places" if few else ""


def _more_text(one: PairedMetric) -> str:
    if not one.more_places:
        return ""
    wanted = "are wanted" if one.verdict == "too few places" else "would decide"
    return f"; {counted(one.more_places, 'more place')} {wanted}"


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
        rows = counted(column.rows, "row differs", "rows differ")
        yield f"           {visible(name)}: {rows}{far}"


def _judged_lines(one: PairedMetric) -> Iterator[str]:
    label = {"worse": "WORSE", "too few places": "too few"}.get(one.verdict, one.verdict)
    yield f"{label:11}{visible(one.path)}: {_value(one.before)} -> {_value(one.after)}"
    ends = "" if math.isnan(one.low) else "95 % "
    ends += between(one.low, one.high, "+.3g")
    seen = "" if not math.isfinite(one.could_see) else f"; detectable: {one.could_see:.3g}"
    allowed = f"; allowed {one.allowed:.3g}" if one.allowed else ""
    drives, places = counted(one.drives, "drive"), counted(one.places, "place")
    over = f"over {drives} at {places}{seen}{_more_text(one)}{allowed}"
    yield f"{'':11}{one.after - one.before:+.3g} ({ends}) {over}"


def _value(value: float) -> str:
    return "not scored" if math.isnan(value) else f"{value:.6g}"
