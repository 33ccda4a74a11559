"""Contribution of each drive to the metrics that runs are compared by: a sum and its rows."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple

import pyarrow as pa

from crosscue.eval.runs.tables.columns import OF_SCORE, arrow_schema

from .metric_values import MetricValue, metric_values

# Folder of a score, in a run or in a study.
FOLDER: Final = "score"
METRICS: Final = "metrics.json"
BY_DRIVE: Final = "by_drive"
Direction = Literal["higher", "lower"]
Kind = Literal["mean", "rms", "sum"]
# Better direction by the last part of a metric's path; other metrics are shown but not judged. The
# amount scored is not judged. The mean distance at detection is judged with undetected approaches
# counted as 0 m, because an additional, late detection would otherwise lower it.
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
OR_0: Final = "_or_0"
SCORED: Final = "scored"
# Also stored for each drive, for queries, and to find metrics that are no longer scored.
SHOWN: Final = frozenset({SCORED, "detected_m", "full_m"})
# Metrics below these are based on few rows each; they are shown but not judged.
PARTS: Final = (
    "by_distance",
    "by_control",
    "by_intersection",
    "by_drive",
    "readings",
    "things",
    "attribution",
)


class DriveMetric(NamedTuple):
    """Contribution of one drive to one metric.

    Attributes:
        log: Identity of the drive's log, by which two runs of it are paired.
        metric: Path of the metric.
        kind: How contributions are combined: mean over rows, its root, or sum.
        total: Sum over rows; of squares for ``rms``.
        rows: Number of rows; 0 if the drive has none.
        places: Places of the drive; empty if unknown, when it is a place of its own.
    """

    log: str
    metric: str
    kind: Kind
    total: float
    rows: int
    places: Sequence[str] = ()


def direction(path: str) -> Direction | None:
    """Return the better direction of a metric; None if it is not judged."""
    parts = path.split(".")
    return None if set(parts) & set(PARTS) else BETTER.get(parts[-1])


def no_longer_scored(
    before: Sequence[DriveMetric], after: Sequence[DriveMetric]
) -> tuple[str, ...]:
    """Return the metrics that the first run of a common drive has and the second lacks."""
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


def drive_contributions(
    log: str, tree: Mapping[str, Any], pose_rmse_m: float | None, is_lost: bool
) -> Iterator[DriveMetric]:
    """Yield the contributions of one drive to all metrics that are judged or shown.

    Args:
        log: Identity of its log.
        tree: Scores of the drive, from ``as_metrics``.
        pose_rmse_m: Absolute pose error; None if the pose was not scored.
        is_lost: True if the pose was lost.
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


# Sibling of a metric of a condition that is the number of its approaches.
COUNTED_BY: Final = {
    "detected": "approaches",
    "full": "approaches",
    "detected_m": "detected",
    "full_m": "full",
}


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
    """Return the mean distance over all approaches of known range, undetected ones at 0 m."""
    outer = part.metric.rpartition(".")[0]
    unknown = values.get(f"{outer}.without_range", MetricValue(0.0)).value
    rows = int(values[f"{outer}.approaches"].value - unknown)
    return part._replace(metric=part.metric + OR_0, rows=rows)


def by_drive_table(parts: Iterator[DriveMetric]) -> pa.Table:
    """Return the table ``by_drive.parquet``."""
    schema = arrow_schema(OF_SCORE[BY_DRIVE])
    return pa.Table.from_pylist([one._asdict() for one in parts], schema)
