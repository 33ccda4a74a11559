"""Tables of a catalog: columns, SQL types and meanings.

``runs``, ``approaches``, ``dropped`` and ``left_out`` are stored in the catalog's index. The others
are the runs' own Parquet files. They may have more columns than are listed here, and a table that
is not listed, such as ``detections``, can be queried by the name of its file.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    import pyarrow as pa


class Column(NamedTuple):
    """One column.

    Attributes:
        kind: SQL type.
        meaning: Meaning in one phrase.
    """

    kind: str
    meaning: str


_RUN: Final = {"run": Column("VARCHAR", "path of the run, relative to the folder of the catalog")}
_LOG_TIME: Final = {
    "segment": Column("INTEGER", "time segment of the drive, from 0"),
    "log_t_ns": Column("BIGINT", "time on the log's own clock"),
}
_STEP: Final = {
    **_RUN,
    "t_ns": Column("BIGINT", "log time"),
    "approach": Column("BIGINT", "number of the approach in its run; null between approaches"),
}
# Tables of the index, by name.
INDEXED: Final[Mapping[str, Mapping[str, Column]]] = {
    "runs": {
        **_RUN,
        "name": Column("VARCHAR", "last part of the path"),
        "outcome": Column("VARCHAR", "whole, losses where rows were dropped, or failed"),
        "exit_status": Column("INTEGER", "0, 3 where rows were dropped, or that of a failed run"),
        "error": Column("VARCHAR", "error of the last attempt; null if it did not fail"),
        "stage": Column("VARCHAR", "estimate; detect if not yet estimated; null of a failed run"),
        "identity": Column(
            "VARCHAR", "hash of the drive's logs, 64 hex digits; equal for all runs of a drive"
        ),
        "logs": Column("VARCHAR[]", "names of the drive's logs"),
        "is_simulated": Column("BOOLEAN", "whether a log is simulated"),
        "vehicle": Column("VARCHAR", "name in the vehicle file"),
        "crosscue": Column("VARCHAR", "version that made the run"),
        "crosscue_commit": Column("VARCHAR", "commit of crosscue, if it ran from a checkout"),
        "models": Column(
            "STRUCT(name VARCHAR, identity VARCHAR)[]",
            "detectors; the identity is a hash of weights, settings and code",
        ),
        "settings": Column("VARCHAR", "JSON of all settings: (settings->>'$.fusion.established')"),
        "settings_sha256": Column("VARCHAR", "hash of settings, models and selection of the logs"),
        "tags": Column("MAP(VARCHAR, VARCHAR)", "set by crosscue tag: tags['weather']"),
        "conditions": Column("VARCHAR[]", "conditions of the drive's approaches, from the truth"),
        "start_ns": Column("BIGINT", "drive time at which the drive starts"),
        "end_ns": Column("BIGINT", "drive time at which it ends"),
        "made_at": Column("TIMESTAMP", "when the run was finished, UTC"),
        "seconds": Column("DOUBLE", "wall time of the run; null without timings.json"),
        "travelled_m": Column("DOUBLE", "length of the track; null without estimate"),
        "frames": Column("BIGINT", "number of camera frames; null without detectors"),
        "approaches": Column("BIGINT", "number of approaches that the run found"),
        "is_scored": Column("BOOLEAN", "whether the run has a score"),
        "rows_in": Column("BIGINT", "input rows over all stages"),
        "rows_used": Column("BIGINT", "rows used"),
        "rows_skipped": Column("BIGINT", "rows skipped, with reasons in the manifest"),
        "rows_dropped": Column("BIGINT", "rows dropped, with reasons in the table dropped"),
        "notices": Column("VARCHAR[]", "notices of the run"),
        "tables": Column("VARCHAR[]", "names of the run's Parquet files"),
    },
    "approaches": {
        **_RUN,
        "approach": Column("BIGINT", "number in its run; null if the run did not find it"),
        "start_ns": Column("BIGINT", "first log time of the run's approach"),
        "end_ns": Column("BIGINT", "last log time"),
        "detected_ns": Column("BIGINT", "log time of the detection; null without"),
        "detected_range_m": Column("DOUBLE", "range estimated at the detection"),
        "reference": Column("VARCHAR", "reference of ranges: start or end of the intersection"),
        "probabilities": Column("MAP(VARCHAR, DOUBLE)", "last belief: probabilities['left']"),
        "not_seen": Column("VARCHAR[]", "features without an observation by any cue"),
        "truth": Column("BIGINT", "id in the truth; null without truth, or if not in the truth"),
        "intersection": Column("VARCHAR", "name of the intersection in the truth"),
        "control": Column("VARCHAR", "stop_sign, traffic_light or none"),
        "conditions": Column("VARCHAR[]", "conditions in the truth, such as 'dusk'"),
        "present": Column("VARCHAR[]", "features that are present"),
        "detected_m": Column("DOUBLE", "true distance at which it was detected; null if never"),
        "full_m": Column("DOUBLE", "the same for all features; null if never"),
        "features_m": Column("MAP(VARCHAR, DOUBLE)", "true distance of each present feature"),
        "false_features": Column("VARCHAR[]", "absent features that were detected"),
        "why_not_detected": Column("VARCHAR", "why it was not detected; empty if it was"),
        "why_not_full": Column("VARCHAR", "why not all features were; empty if they were"),
        "tags": Column("MAP(VARCHAR, VARCHAR)", "tags of the run"),
    },
    "dropped": {
        **_RUN,
        "stage": Column("VARCHAR", "reading, detecting or estimating"),
        "stream": Column("VARCHAR", "topic, camera or input"),
        "reason": Column("VARCHAR", "reason"),
        "rows": Column("BIGINT", "number of rows; null if unknown"),
    },
    "left_out": {
        **_RUN,
        "reason": Column("VARCHAR", "why the run is left out"),
    },
}
# Tables of the runs themselves, by name.
OWN: Final[Mapping[str, Mapping[str, Column]]] = {
    "cues": {
        **_STEP,
        "cue": Column("VARCHAR", "its name"),
        "count": Column("BIGINT", "how many were found in the frame"),
        **_LOG_TIME,
    },
    "scores": {
        **_RUN,
        "log": Column("VARCHAR", "identity of the drive's logs; equal for all runs of a drive"),
        "metric": Column("VARCHAR", "path, such as cues.stop_sign.precision"),
        "kind": Column("VARCHAR", "pooling over drives: mean, rms or sum"),
        "total": Column("DOUBLE", "sum over the drive's rows; of squares for rms"),
        "rows": Column("BIGINT", "number of rows"),
        "places": Column("VARCHAR[]", "places of the drive, which comparisons resample"),
        "value": Column("DOUBLE", "value of this drive alone"),
    },
    "belief": {
        **_STEP,
        "intersection": Column("DOUBLE", "probability"),
        "left": Column("DOUBLE", 'probability; SQL needs "left" in quotes'),
        "right": Column("DOUBLE", 'probability; SQL needs "right" in quotes'),
        "straight": Column("DOUBLE", "probability"),
        "established": Column("BOOLEAN", "whether a road was established"),
        **_LOG_TIME,
    },
    "range": {
        **_STEP,
        "reference": Column("VARCHAR", "start or end of the intersection"),
        "range_m": Column("DOUBLE", "estimated range"),
        "var_m2": Column("DOUBLE", "variance of the estimate"),
        "measured_m": Column("DOUBLE", "range measured in this step; null without"),
        **_LOG_TIME,
    },
    "pose": {
        **_RUN,
        "t_ns": Column("BIGINT", "log time"),
        "x_m": Column("DOUBLE", "position"),
        "y_m": Column("DOUBLE", "position"),
        "heading_rad": Column("DOUBLE", "counterclockwise from the x axis"),
        "speed_mps": Column("DOUBLE", "speed"),
        "major_axis_m": Column("DOUBLE", "major axis of the 2-sigma ellipse"),
        "travelled_m": Column("DOUBLE", "distance since the start"),
        "landmark": Column("VARCHAR", "landmark that corrected this pose; null without"),
        **_LOG_TIME,
    },
    "cue_frames": {
        **_RUN,
        "t_ns": Column("BIGINT", "log time"),
        "cue": Column("VARCHAR", "its name"),
        "count": Column("BIGINT", "how many were found in the frame"),
        "approach": Column("BIGINT", "id in the truth"),
        "distance_m": Column("DOUBLE", "true distance to the intersection"),
        "object": Column("BIGINT", "1 if the object is present, 0 if not, null if unknown"),
        "feature": Column("BIGINT", "the same for the feature that the cue indicates"),
        "true_count": Column("BIGINT", "true number of objects; null if unknown"),
        "visible": Column("DOUBLE", "visible fraction"),
    },
    "curves": {
        **_RUN,
        "approach": Column("BIGINT", "id in the truth"),
        "t_ns": Column("BIGINT", "log time"),
        "distance_m": Column("DOUBLE", "true distance to the intersection"),
        "left": Column("DOUBLE", "probability"),
        "right": Column("DOUBLE", "probability"),
        "straight": Column("DOUBLE", "probability"),
    },
}
# Path of a table in a run, if it is not stored under its own name.
FILES: Final[Mapping[str, str]] = {
    "scores": "score/by_drive.parquet",
    "cue_frames": "score/cue_frames.parquet",
    "curves": "score/curves.parquet",
}
# SQL of the tables that are computed from a file.
VIEWS: Final[Mapping[str, str]] = {
    "scores": "select run, log, metric, kind, total, rows, places, case kind when 'sum' then total "
    "when 'rms' then sqrt(total / nullif(rows, 0)) else total / nullif(rows, 0) end as value "
    "from {table}",
}


def arrow_schema(columns: Mapping[str, Column]) -> pa.Schema:
    """Return the columns as an Arrow schema."""
    import pyarrow as pa

    texts = pa.list_(pa.string())
    types = {
        "VARCHAR": pa.string(),
        "VARCHAR[]": texts,
        "BIGINT": pa.int64(),
        "INTEGER": pa.int32(),
        "DOUBLE": pa.float64(),
        "BOOLEAN": pa.bool_(),
        "TIMESTAMP": pa.timestamp("us"),
        "MAP(VARCHAR, VARCHAR)": pa.map_(pa.string(), pa.string()),
        "MAP(VARCHAR, DOUBLE)": pa.map_(pa.string(), pa.float64()),
        "STRUCT(name VARCHAR, identity VARCHAR)[]": pa.list_(
            pa.struct({"name": pa.string(), "identity": pa.string()})
        ),
    }
    return pa.schema({name: types[column.kind] for name, column in columns.items()})
