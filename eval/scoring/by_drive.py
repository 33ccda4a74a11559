"""What each drive adds to the metrics that two runs are compared by: a sum over some rows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
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
            "scored",
            "matched",
            "detected",
            "full",
            "full_from_8_m",
            "detected_m",
            "full_m",
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
"""By the last part of a metric's path; metrics of other names are shown but not judged."""
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


def parts_of(
    log: str, tree: Mapping[str, Any], pose_rmse_m: float | None, is_lost: bool
) -> Iterator[DriveMetric]:
    """What one drive adds to every judged metric.

    Args:
        log: Identity of its log.
        tree: Its own scores as ``as_metrics`` returns them.
        pose_rmse_m: Absolute pose error; None where the pose was not scored.
        is_lost: The pose was lost.
    """
    sections = {name: tree[name] or {} for name in ("cues", "approaches", "belief", "range")}
    values = metric_values(sections, parts=False)
    for path, value in values.items():
        if direction(path) is not None:
            yield _part(log, path, value, values)
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
