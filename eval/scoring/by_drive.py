"""What each drive adds to the metrics that two runs are compared by: a sum over some rows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from .metric_values import MetricValue, metric_values

if TYPE_CHECKING:
    import pyarrow as pa

FOLDER: Final = "score"
"""Of a score, in a run or in a study."""
METRICS: Final = "metrics.json"
BY_DRIVE: Final = "by_drive"
Direction = Literal["higher", "lower"]
Kind = Literal["mean", "rms", "sum"]
BETTER: Final[Mapping[str, Direction]] = {
    **dict.fromkeys(
        (
            "precision",
            "recall",
            "matched",
            "detected",
            "full",
            "full_from_8_m",
            "detected_m_or_0",
            "full_m_or_0",
        ),
        "higher",
    ),
    **dict.fromkeys(
        (
            "brier",
            "log_score",
            "rmse_m",
            "ape_rmse_m",
            "extra",
            "extra_detected",
            "splits",
            "false_features",
            "lost",
        ),
        "lower",
    ),
}
"""By the last part of a metric's path; metrics of other names are shown but not judged.

How much was scored is no merit. Nor is the mean distance of the approaches that were detected: one
more, detected late, lowers it. So where it is judged, approaches not detected count as 0 m.
"""
OR_0: Final = "_or_0"
SCORED: Final = "scored"
SHOWN: Final = frozenset({SCORED, "detected_m", "full_m"})
"""Kept for each drive, too, for queries, and to see what is no longer scored at all."""
PARTS: Final = (
    "by_distance",
    "by_control",
    "by_intersection",
    "by_drive",
    "readings",
    "things",
    "attribution",
)
"""Metrics below these stand on few rows each; they are shown but not judged."""


class DriveMetric(NamedTuple):
    """One drive's part of one metric.

    Attributes:
        log: Identity of the drive's log: what pairs two runs of it.
        metric: Its path.
        kind: Of parts from several drives: the mean over rows, its root, or the sum.
        total: Sum over rows, of squares for ``rms``.
        rows: How many; 0 where the drive has none.
    """

    log: str
    metric: str
    kind: Kind
    total: float
    rows: int


def direction(path: str) -> Direction | None:
    """Which of two values of a metric is better; None where it is not judged."""
    parts = path.split(".")
    return None if set(parts) & set(PARTS) else BETTER.get(parts[-1])


def no_longer_scored(
    before: Sequence[DriveMetric], after: Sequence[DriveMetric]
) -> tuple[str, ...]:
    """Paths that drives of both have only in the first run, or of which no row is scored now."""
    known = {one.metric for one in after}
    logs = {one.log for one in before} & {one.log for one in after}
    scored = {one.metric for one in after if one.log in logs and one.total > 0.0}

    def is_lost(one: DriveMetric) -> bool:
        if one.log not in logs:
            return False
        if one.metric not in known:
            return one.rows > 0
        was_scored = one.metric.endswith(f".{SCORED}") and one.total > 0.0
        return was_scored and one.metric not in scored

    return tuple(dict.fromkeys(one.metric for one in before if is_lost(one)))


def parts_of(
    log: str, tree: Mapping[str, Any], pose_rmse_m: float | None, is_lost: bool
) -> Iterator[DriveMetric]:
    """What one drive adds to every metric that is judged or shown.

    Args:
        log: Identity of its log.
        tree: Its own scores as ``as_metrics`` returns them.
        pose_rmse_m: Absolute pose error; None where the pose was not scored.
        is_lost: The pose was lost.
    """
    sections = {name: tree[name] or {} for name in ("cues", "approaches", "belief", "range")}
    values = metric_values(sections, parts=False)
    for path, value in values.items():
        name = path.rpartition(".")[2]
        if direction(path) is not None or (name in SHOWN and not set(path.split(".")) & {*PARTS}):
            part = _part(log, path, value, values)
            yield part
            if name in SHOWN - {SCORED}:
                yield _of_all(part, values)
    if pose_rmse_m is not None:
        yield _part(log, "pose.ape_rmse_m", MetricValue(pose_rmse_m, of=1), {})
        yield _part(log, "pose.lost", MetricValue(float(is_lost)), {})


COUNTED_BY: Final = {
    "detected": "approaches",
    "full": "approaches",
    "detected_m": "detected",
    "full_m": "full",
}
"""Under a condition: the count beside a metric that says how many approaches it stands on."""


def _part(
    log: str, path: str, value: MetricValue, values: Mapping[str, MetricValue]
) -> DriveMetric:
    outer, _, name = path.rpartition(".")
    if "by_condition" in path.split(".") and name in COUNTED_BY:
        rows = int(values[f"{outer}.{COUNTED_BY[name]}"].value)
        is_mean = name.endswith("_m")
        total = (rows * value.value if is_mean else value.value) if rows else 0.0
        return DriveMetric(log, path, "mean", total, rows)
    if math.isnan(value.value):
        return DriveMetric(log, path, "rms" if name == "rmse_m" else "mean", 0.0, 0)
    if name == "rmse_m":
        rows = int(values[f"{outer}.scored"].value)
        return DriveMetric(log, path, "rms", rows * value.value**2, rows)
    if value.of is not None:
        return DriveMetric(log, path, "mean", value.of * value.value, value.of)
    return DriveMetric(log, path, "sum", value.value, 1)


def _of_all(part: DriveMetric, values: Mapping[str, MetricValue]) -> DriveMetric:
    """A mean distance over every approach whose range is known, those not detected at 0 m."""
    outer = part.metric.rpartition(".")[0]
    unknown = values.get(f"{outer}.without_range", MetricValue(0.0)).value
    rows = int(values[f"{outer}.approaches"].value - unknown)
    return part._replace(metric=part.metric + OR_0, rows=rows)


def table_of(parts: Iterator[DriveMetric]) -> pa.Table:
    """As ``by_drive.parquet``."""
    import pyarrow as pa

    schema = pa.schema(
        {
            "log": pa.string(),
            "metric": pa.string(),
            "kind": pa.string(),
            "total": pa.float64(),
            "rows": pa.int64(),
        }
    )
    return pa.Table.from_pylist([one._asdict() for one in parts], schema)
