"""Write the files of a score: metrics as JSON, and curves, frames and drives as tables."""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from crosscue.eval.runs.tables.columns import OF_SCORE, arrow_schema
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_table, write_text

from .by_drive import BY_DRIVE, METRICS, DriveMetric, by_drive_table, drive_contributions
from .drives import DriveJudged, as_metrics, pool_scores
from .runs import RunScored
from .truth import FEATURES

CURVES: Final = "curves"
CUE_FRAMES: Final = "cue_frames"
APPROACHES: Final = "approaches"


def write_scores(folder: Path, scored: Sequence[RunScored], metrics: Mapping[str, Any]) -> None:
    """Write ``metrics.json``; ``curves``, ``cue_frames``, ``approaches``, ``by_drive`` as Parquet.

    Raises:
        OutputError: A file cannot be written.
    """
    write_text(folder / METRICS, strict_json(metrics) + "\n")
    judged = [one.judged for one in scored]
    parts = chain.from_iterable(map(_parts, scored))
    tables = {
        CURVES: curve_table(judged),
        CUE_FRAMES: cue_frame_table(judged),
        APPROACHES: approach_table(judged),
    }
    for name, table in (tables | {BY_DRIVE: by_drive_table(parts)}).items():
        write_table(folder / f"{name}.parquet", table)


def _parts(one: RunScored) -> Iterator[DriveMetric]:
    logs = "+".join(sorted(log.identity.digest for log in one.run.drive_manifest().logs))
    rmse_m = None if one.pose is None else one.pose.ape["none"].translation_m.rmse
    is_lost = one.pose is not None and one.pose.lost_at_m is not None
    places = sorted(set(one.truth.places.values()))
    for part in drive_contributions(logs, as_metrics(pool_scores([one.judged])), rmse_m, is_lost):
        yield part._replace(places=places)


def curve_table(judged: Sequence[DriveJudged]) -> pa.Table:
    """Return probabilities and true distance, one row per step of each matched approach."""
    curves = [
        curve for one in judged if one.approaches is not None for curve in one.approaches.curves
    ]
    own = sorted({name for curve in curves for name in curve.features} - set(FEATURES))
    missing = {len(c.t_ns): np.full(len(c.t_ns), math.nan) for c in curves}
    columns: dict[str, Any] = {
        "drive": _repeated([(c.drive, len(c.t_ns)) for c in curves]),
        "approach": pa.array([c.approach for c in curves for _ in c.t_ns], pa.int64()),
        "intersection": _repeated([(c.intersection, len(c.t_ns)) for c in curves]),
        "t_ns": _joined([c.t_ns for c in curves], np.int64),
        "distance_m": _joined([c.distance_m for c in curves], np.float64),
    }
    for name in (*FEATURES, *own):
        parts = [c.features.get(name, missing[len(c.t_ns)]) for c in curves]
        columns[name] = _joined(parts, np.float64)
    return pa.table(columns)


def approach_table(judged: Sequence[DriveJudged]) -> pa.Table:
    """Return each approach of the truth with its result; unknown distances are null."""
    schema = arrow_schema(OF_SCORE[APPROACHES])
    results = [
        one for drive in judged if drive.approaches is not None for one in drive.approaches.results
    ]
    rows = [
        {
            **{name: getattr(one, name) for name in schema.names if name != "truth"},
            "approach": one.run_approach,
            "truth": one.approach,
            "detected_m": _known(one.detected_m),
            "full_m": _known(one.full_m),
            "features_m": [(name, _known(far_m)) for name, far_m in one.features_m.items()],
        }
        for one in results
    ]
    return pa.Table.from_pylist(rows, schema)


def _known(distance_m: float | None) -> float | None:
    return None if distance_m is None or math.isnan(distance_m) else distance_m


def cue_frame_table(judged: Sequence[DriveJudged]) -> pa.Table:
    """Return each frame in which a cue was searched, with the truth about it."""
    rows = [cue for one in judged for cue in one.cues if len(cue.t_ns)]
    columns: dict[str, Any] = {
        "drive": _repeated([(c.drive, len(c.t_ns)) for c in rows]),
        "t_ns": _joined([c.t_ns for c in rows], np.int64),
        "cue": _repeated([(c.cue, len(c.t_ns)) for c in rows]),
        "count": _joined([c.count for c in rows], np.int64),
    }
    for name, parts in (
        ("approach", [c.approach for c in rows]),
        ("object", [c.is_object for c in rows]),
        ("feature", [c.is_feature for c in rows]),
        ("true_count", [c.true_count for c in rows]),
    ):
        values = _joined(parts, np.int64)
        columns[name] = pa.array(values, mask=values < 0)
    columns["distance_m"] = _joined([c.distance_m for c in rows], np.float64)
    columns["visible"] = _joined([c.visible for c in rows], np.float64)
    return pa.table(columns)


def _repeated(names: Sequence[tuple[str, int]]) -> pa.Array:
    return pa.array([name for name, times in names for _ in range(times)], pa.string())


def _joined(parts: Sequence[Any], kind: type) -> Any:
    return np.concatenate([np.empty(0, kind), *parts]).astype(kind)
